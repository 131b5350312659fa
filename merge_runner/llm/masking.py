"""Mask secrets in texts, however JSON spells them."""

from __future__ import annotations

import re
from bisect import bisect_left
from collections.abc import Callable, Iterable, Iterator

MASK = "[key]"
# A run of so many characters of a secret is masked, too. Wherever it begins, it contains one of the
# secret's pieces, each half as long.
RUN = 12
PIECE = RUN // 2
# Routers pass on errors as JSON in a string of JSON, which is escaped once more.
NESTED = 8
ESCAPE = re.compile(r'\\(?:u([0-9a-fA-F]{4})|(["\\/bfnrt]))')
CONTROLS = {"b": "\b", "f": "\f", "n": "\n", "r": "\r", "t": "\t"}


class Mask:
    """Replacement of secrets, and of runs of at least RUN of their characters, by MASK.

    They may contain escapes of JSON, also in a string within a string.
    """

    def __init__(self, secrets: Iterable[str]) -> None:
        given = [*secrets]
        self._pieces = {
            secret[at : at + PIECE]
            for secret in given
            for at in range(0, len(secret) - PIECE + 1, PIECE)
        }
        # Part of every escaped spelling of their characters.
        self._escape = "\\" if any({*secret} & {*'/"\\'} for secret in given) else "\\u00"
        self._hints = re.compile("|".join(map(re.escape, [*self._pieces, self._escape])))
        runs = {s[at : at + RUN] for s in given for at in range(max(1, len(s) - RUN + 1))}
        # All runs at all offsets; a short secret is one run.
        longest_first = sorted(map(re.escape, runs), key=len, reverse=True)
        self._runs = re.compile(f"(?=({'|'.join(longest_first)}))")

    def __call__(self, text: str) -> str:
        """Return the text without the secrets."""
        if self._hints.search(text) is None:
            return text
        kept, done = [], 0
        for begin, end in sorted(self._spans(text, NESTED)):
            if begin >= done:
                kept += [text[done:begin], MASK]
            done = max(done, end)
        return "".join([*kept, text[done:]])

    def _spans(self, text: str, nested: int) -> Iterator[tuple[int, int]]:
        """Yield the spans of secrets in a text, escaped ones included."""
        if any(piece in text for piece in self._pieces):
            yield from (match.span(1) for match in self._runs.finditer(text))
        if nested and self._escape in text:
            spans = [*self._spans(ESCAPE.sub(unescaped, text), nested - 1)]
            offset = offsets(text) if spans else int
            yield from ((offset(begin), offset(end)) for begin, end in spans)


def unescaped(escape: re.Match[str]) -> str:
    """Return the character of an escape of JSON."""
    code, letter = escape.groups()
    return chr(int(code, 16)) if code else CONTROLS.get(letter, letter)


def offsets(text: str) -> Callable[[int], int]:
    """Return a function from an offset in the unescaped text to the offset in the text."""
    begins, longer = [], [0]
    for escape in ESCAPE.finditer(text):
        begins.append(escape.start() - longer[-1])
        longer.append(longer[-1] + len(escape[0]) - 1)
    return lambda offset: offset + longer[bisect_left(begins, offset)]
