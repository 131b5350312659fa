"""The words of the project as its glossary explains them, for the pages."""

from __future__ import annotations

import re
from functools import cache
from pathlib import Path

from markupsafe import Markup, escape

from merge_runner.paths import shipped

FILE = shipped(Path(__file__).with_name("glossary.md"), "docs/glossary.md")
# Terms that a page explains where it has their words: (words as the page has them, term, pattern).
USED = (
    ("factor, level", "factor", "factor|level"),
    ("difference, interaction (×)", "effect", "×"),
    ("80 % power", "detectable", "80 % power"),
    ("interval [ ]", "interval", r"\["),
    ("p, corrected", "corrected p", "corrected"),
    ("prompt, Baseline", "prompt variant", "prompt"),
    ("headway, ahead, side by side", "projected headway", "headway|ahead|side by side"),
    ("crash", "collision", "crash"),
    ("valid reply, plan", "plan", "valid|plan"),
    ("gap at the merge point", "gap", r"\bgap\b"),
    ("deviation from the initial speed", "RMSE", "initial speed"),
    ("both change their speed", "joint contribution", "change their speed"),
    ("mock model", "mock model", "mock model"),
)
CRASH = "<em>crash</em> on pages"  # where a page explains it, it has this word
_ON_PAGES = re.compile(r"the <strong>human (\w+)</strong> \(pages: <em>(.+?)</em>\)")
_ROW = re.compile(r"\| (.+?) \| (.+) \|")
_MARKED = (
    (re.compile(r"\*\*(.+?)\*\*"), r"<strong>\1</strong>"),
    (re.compile(r"\*(.+?)\*"), r"<em>\1</em>"),
    (re.compile(r"`(.+?)`"), r"<code>\1</code>"),
    (re.compile(r" \(\[[^]]+\]\([^)]+\)\)"), ""),
    (re.compile(r"\[(.+?)\]\(.+?\)"), r"\1"),
)


@cache
def sections() -> dict[str, list[tuple[str, Markup]]]:
    """Return all terms by heading, each with its meaning.

    Links of the meanings lead nowhere from a page, and become their texts.
    """
    by_heading: dict[str, list[tuple[str, Markup]]] = {}
    for line in FILE.read_text(encoding="utf-8").splitlines():
        if line.startswith("## "):
            words = by_heading.setdefault(line[3:], [])
        elif (row := _ROW.fullmatch(line)) and row[1] not in {"term", "---"}:
            meaning = str(escape(row[2]))
            for pattern, html in _MARKED:
                meaning = pattern.sub(html, meaning)
            words.append((row[1], Markup(meaning)))  # noqa: S704 # escaped above
    return by_heading


def used_terms(html: str) -> list[tuple[str, Markup]]:
    """Return the words of a page that are terms, with their meanings."""
    text = re.sub("<[^>]*>", " ", html).lower()
    meanings = {word: meaning for words in sections().values() for word, meaning in words}
    meaning = str(meanings["collision"]).removeprefix(f"{CRASH}. ")
    meanings["collision"] = Markup(_ON_PAGES.sub(r"<strong>\2 \1</strong>", meaning))  # noqa: S704
    return [(words, meanings[term]) for words, term, used in USED if re.search(used, text)]
