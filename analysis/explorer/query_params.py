"""Numbers in an address, which may hold anything."""

from __future__ import annotations

import re

_SECONDS = re.compile(r"[0-9]{1,12}(\.[0-9]{1,6})?")


def whole(text: str) -> int | None:
    """A number of up to 7 digits; None for anything else."""
    return int(text) if text.isascii() and text.isdigit() and len(text) < 8 else None


def seconds(text: str) -> float:
    """A time in s since 1970; 0 for anything else."""
    return float(text) if _SECONDS.fullmatch(text) else 0.0
