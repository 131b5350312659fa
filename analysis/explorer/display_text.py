"""What a model wrote, made visible: nothing in it may hide, or turn the page around."""

from __future__ import annotations

import unicodedata

SHOWN = 20_000
BEGINNING = 800
# Formats that show nothing, among them those that turn the direction of writing.
_HIDDEN = {"Cc", "Cf", "Cs", "Co", "Cn", "Zl", "Zp"}
# Letters and marks that show nothing either: fillers, joiners, and selectors of variants.
_BLANK = {0x034F, 0x115F, 0x1160, 0x17B4, 0x17B5, 0x2800, 0x3164, 0xFFA0}
_BLANK.update(range(0x180B, 0x1810), range(0xFE00, 0xFE10), range(0xE0100, 0xE01F0))


def visible(text: str) -> str:
    """A text with every character that does not show as its code point: ``[U+202E]``."""
    if text.isascii() and text.isprintable():
        return text
    return "".join(c if _shows(c) else f"[U+{ord(c):04X}]" for c in text)


def _shows(c: str) -> bool:
    if ord(c) in _BLANK:
        return False
    return c in "\n\t" or c.isprintable() or unicodedata.category(c) not in _HIDDEN


def shortened(text: str) -> tuple[str, int]:
    """The beginning of a text, and how many characters are left out."""
    return visible(text[:SHOWN]), max(0, len(text) - SHOWN)


def clamped(text: str) -> tuple[str, str, int]:
    """What a text begins with, as much more as is shown, and how many characters are left out."""
    shown, more = shortened(text[BEGINNING:])
    return visible(text[:BEGINNING]), shown, more
