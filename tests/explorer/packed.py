"""What an exported page holds packed, as its scripts read it."""

from __future__ import annotations

import base64
import json
import zlib


def unpacked(text):
    """What a script reads of a packed text."""
    return json.loads(zlib.decompress(base64.b64decode(text)))
