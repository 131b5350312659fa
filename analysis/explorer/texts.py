"""What a model wrote, made visible: nothing in it may hide, or turn the page around."""

from __future__ import annotations

import unicodedata

SHOWN = 20_000
# Formats that show nothing, among them those that turn the direction of writing.
_HIDDEN = {"Cc", "Cf", "Cs", "Co", "Cn", "Zl", "Zp"}


def visible(text: str) -> str:
    """A text with every character that does not show as its code point: ``[U+202E]``."""
    if text.isascii() and text.isprintable():
        return text
    return "".join(
        c
        if c in "\n\t" or c.isprintable() or unicodedata.category(c) not in _HIDDEN
        else f"[U+{ord(c):04X}]"
        for c in text
    )


def shortened(text: str) -> tuple[str, int]:
    """The beginning of a text, and how many characters are left out."""
    return visible(text[:SHOWN]), max(0, len(text) - SHOWN)
