"""Values as texts, and texts made visible: nothing in them may hide, or turn the page around."""

from __future__ import annotations

import json
import re
import unicodedata
from contextlib import suppress
from decimal import Decimal

from markupsafe import Markup, escape

from merge_runner.text_safety import in_spreadsheet
from merge_runner_analysis.wording import MINUS

NEGATIVE = re.compile(r"(?<![\w-])-(?=\d)")
_NAME = re.compile(r"[\w.+=]+(?:-[\w.+=]+)+")
SHOWN = 20_000
BEGINNING = 800
# All that may not show.
_ODD = re.compile(r"[^\n\t -~]")
# Formats that show nothing, among them those that turn the direction of writing.
_HIDDEN = {"Cc", "Cf", "Cs", "Co", "Cn", "Zl", "Zp"}
# Letters and marks that show nothing either: fillers, joiners, and selectors of variants.
_BLANK = {0x034F, 0x115F, 0x1160, 0x17B4, 0x17B5, 0x2800, 0x3164, 0xFFA0}
_BLANK.update(range(0x180B, 0x1810), range(0xFE00, 0xFE10), range(0xE0100, 0xE01F0))


def with_minus(text: str) -> str:
    """Return a text with true minus signs before negative numbers; hyphens stay, also in names."""
    return NEGATIVE.sub(MINUS, text)


def with_whole_names(text: str) -> Markup:
    """Return a text as HTML in which no line breaks at the hyphen of a name."""
    return Markup(_NAME.sub(r'<span class="nw">\g<0></span>', str(escape(visible(text)))))  # noqa: S704 # escaped


def visible(text: str) -> str:
    """Return a text with every invisible character as its code point: ``[U+202E]``."""
    if text.isascii() and text.isprintable():  # most texts, in a tenth of the time
        return text
    return _ODD.sub(lambda odd: odd[0] if _shows(odd[0]) else f"[U+{ord(odd[0]):04X}]", text)


def _shows(c: str) -> bool:
    if ord(c) in _BLANK:
        return False
    return c.isprintable() or unicodedata.category(c) not in _HIDDEN


def shortened(text: str) -> tuple[str, int]:
    """Return the beginning of a text, and the number of characters left out."""
    return visible(text[:SHOWN]), max(0, len(text) - SHOWN)


def clamped(text: str) -> tuple[str, str, int]:
    """Return a text's beginning, its shown continuation, and the number of characters left out."""
    shown, more = shortened(text[BEGINNING:])
    return visible(text[:BEGINNING]), shown, more


def csv_cell(value: object) -> object:
    """Return a value of any type as a cell of CSV."""
    text = text_of(value)
    return text if isinstance(value, int | float | Decimal) else in_spreadsheet(text)


def text_of(value: object) -> str | None:
    """Return a value of any type as a text; None for NULL."""
    if value is None or isinstance(value, str):
        return value
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, list | tuple | dict):
        with suppress(TypeError):  # there are keys that JSON cannot say
            return json.dumps(value, ensure_ascii=False, default=str)
    return str(value)
