"""The words of the project as its glossary explains them, for the pages."""

from __future__ import annotations

import re
from functools import cache
from pathlib import Path
from typing import NamedTuple

from markupsafe import Markup, escape

# A link to docs/glossary.md, which becomes a file of the package when it is built.
FILE = Path(__file__).with_name("glossary.md")
_ROW = re.compile(r"\| (.+?) \| (.+) \|")
_MARKED = (
    (re.compile(r"\*\*(.+?)\*\*"), r"<strong>\1</strong>"),
    (re.compile(r"`(.+?)`"), r"<code>\1</code>"),
    (re.compile(r" \(\[[^]]+\]\([^)]+\)\)"), ""),
    (re.compile(r"\[(.+?)\]\(.+?\)"), r"\1"),
)


class Word(NamedTuple):
    """A word, or several of one meaning with commas between, and what is meant by it."""

    term: str
    meaning: Markup


@cache
def sections() -> dict[str, list[Word]]:
    """All words by the headings that they stand under."""
    found: dict[str, list[Word]] = {}
    for line in FILE.read_text(encoding="utf-8").splitlines():
        if line.startswith("## "):
            words = found.setdefault(line[3:], [])
        elif (row := _ROW.fullmatch(line)) and row[1] not in {"term", "---"}:
            words.append(Word(row[1], _shown(row[2])))
    return found


def _shown(text: str) -> Markup:
    """A cell of Markdown; of its links, which lead nowhere from a page, the texts stay."""
    shown = str(escape(text))
    for pattern, html in _MARKED:
        shown = pattern.sub(html, shown)
    return Markup(shown)  # noqa: S704 # escaped above
