"""A whole study exported, and what its pages hold packed, as their scripts read it."""

from __future__ import annotations

import base64
import json
import zlib

import pytest

from analysis.explorer.export import export_folder


def unpacked(text):
    """What a script reads of a packed text."""
    return json.loads(zlib.decompress(base64.b64decode(text)))


def export_with_a_table(db, folder):
    """Export the whole study with a table and a figure, which stand for all; gives the paths."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("analysis.explorer.export.TABLES", ["attempts"])
        patch.setattr("analysis.explorer.pages.tables.FIGURES", {"ablation-matrix": "a figure"})
        return list(export_folder(db, folder, []))
