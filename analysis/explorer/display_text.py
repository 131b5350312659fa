"""Values as texts, and texts made visible: nothing in them may hide, or turn the page around."""

from __future__ import annotations

import json
import re
import unicodedata
from datetime import datetime
from decimal import Decimal

from merge_runner.text_safety import in_spreadsheet

MINUS = "−"
NEGATIVE = re.compile(r"(?<![\w-])-(?=\d)")
SHOWN = 20_000
BEGINNING = 800
# What Python gets for infinite timestamps.
INFINITE = {"9999-12-31 23:59:59.999999": "infinity", "0001-01-01 00:00:00": "-infinity"}
# Formats that show nothing, among them those that turn the direction of writing.
_HIDDEN = {"Cc", "Cf", "Cs", "Co", "Cn", "Zl", "Zp"}
# Letters and marks that show nothing either: fillers, joiners, and selectors of variants.
_BLANK = {0x034F, 0x115F, 0x1160, 0x17B4, 0x17B5, 0x2800, 0x3164, 0xFFA0}
_BLANK.update(range(0x180B, 0x1810), range(0xFE00, 0xFE10), range(0xE0100, 0xE01F0))


def shown_number(value: float | None, decimals: int = 2, unit: str = "") -> str:
    """A number with its unit, as all pages print it; an en dash where there is none."""
    return "–" if value is None else f"{value:.{decimals}f}{unit}".replace("-", MINUS)


def with_minus(text: str) -> str:
    """A text whose negative numbers have a true minus sign; hyphens stay, also those of names."""
    return NEGATIVE.sub(MINUS, text)


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


def csv_cell(value: object) -> object:
    """A value of any type for a cell of CSV."""
    text = text_of(value)
    return text if isinstance(value, int | float | Decimal) else in_spreadsheet(text)


def text_of(value: object) -> str | None:
    """A value of any type as a text; None for NULL."""
    match value:
        case None | str():
            return value
        case bool():
            return "true" if value else "false"
        case bytes():
            return f"0x{value.hex()}"
        case datetime():
            text = value.isoformat(" ")
            return INFINITE.get(text, text)
        case list() | tuple() | dict():
            return json.dumps(_plain(value), ensure_ascii=False, default=text_of)
        case _:
            return str(value)


def _plain(value: object) -> object:
    """A nested value whose keys JSON can say."""
    match value:
        case list() | tuple():
            return [_plain(item) for item in value]
        case dict():
            return {str(text_of(key)): _plain(item) for key, item in value.items()}
        case _:
            return value
