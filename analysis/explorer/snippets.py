"""What is looked for in a text, and the places of the text in which it stands."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass

AROUND = 70  # characters on each side of a match
MOST_MATCHES = 20  # that are shown of a text
MOST_TERMS, LONGEST_QUERY = 12, 300
_TERM = re.compile(r'"([^"]*)"?|([^\s"]+)')


@dataclass(frozen=True, slots=True)
class Snippet:
    """Pieces of a text, and whether each matches; ``more`` matches are not shown."""

    pieces: list[tuple[str, bool]]
    more: int


def terms_of(query: str) -> list[str]:
    """The words of a query, and its phrases in quotes.

    >>> terms_of('yield "collision course')
    ['yield', 'collision course']
    """
    found = (
        " ".join((quoted or word).split()) for quoted, word in _TERM.findall(query[:LONGEST_QUERY])
    )
    return list(dict.fromkeys(filter(None, found)))[:MOST_TERMS]


def snippet(text: str, folded: str, terms: Sequence[str]) -> Snippet:
    """The matches of terms with what is around them, or where there is none the beginning.

    ``folded`` and ``terms`` are without capitals, and ``folded`` has a character for each of
    ``text``.
    """
    spans = _spans(folded, terms)
    shown = spans[:MOST_MATCHES]
    pieces: list[tuple[str, bool]] = []
    at = 0
    for i, (begin, end) in enumerate(shown or [(0, 0)]):
        following = shown[i + 1][0] if i + 1 < len(shown) else len(text)
        start = max(at, begin - AROUND)
        if start > at:
            start = text.find(" ", start - 1, begin) + 1 or start  # at a word, if one begins
            pieces.append(("… " if not at else " … ", False))
        pieces += [(text[start:begin], False), (text[begin:end], True)]
        at = min(following, end + AROUND * (1 if shown else 3))
        if at < following:
            last = text.rfind(" ", end + 1, at + 1)
            at = at if last < 0 else last
        pieces.append((text[end:at], False))
    if at < len(text):
        pieces.append((" …", False))
    return Snippet([piece for piece in pieces if piece[0]], len(spans) - len(shown))


def _spans(folded: str, terms: Sequence[str]) -> list[tuple[int, int]]:
    """Where the terms stand: places that overlap or touch are one."""
    spans: list[tuple[int, int]] = []
    places = (
        (match.start(), match.start() + len(term))
        for term in terms
        for match in re.finditer(f"(?={re.escape(term)})", folded)
    )
    for begin, end in sorted(places):
        if spans and begin <= spans[-1][1]:
            spans[-1] = spans[-1][0], max(end, spans[-1][1])
        else:
            spans.append((begin, end))
    return spans
