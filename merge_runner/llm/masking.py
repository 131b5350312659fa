"""Secrets are replaced in texts, however JSON spells them."""

from __future__ import annotations

import re
from bisect import bisect_left
from collections.abc import Callable, Iterable, Iterator

MASK = "[key]"
# So many characters of a secret in a row are masked, too. Wherever they begin in it, they contain
# one of its pieces, each half as long.
RUN = 12
PIECE = RUN // 2
# JSON in a string of JSON, as routers pass on the errors of others, is escaped once more.
NESTED = 8
ESCAPE = re.compile(r'\\(?:u([0-9a-fA-F]{4})|(["\\/bfnrt]))')
CONTROLS = {"b": "\b", "f": "\f", "n": "\n", "r": "\r", "t": "\t"}


class Mask:
    """Replaces secrets, and RUN characters of one in a row or more, in texts.

    They may be spelled with the escapes of JSON, also in a string within a string.
    """

    def __init__(self, secrets: Iterable[str]) -> None:
        given = [*secrets]
        self._pieces = {
            secret[at : at + PIECE]
            for secret in given
            for at in range(0, len(secret) - PIECE + 1, PIECE)
        }
        # The least that any spelling of a character of theirs has.
        self._escape = "\\" if any({*secret} & {*'/"\\'} for secret in given) else "\\u00"
        self._hints = re.compile("|".join(map(re.escape, [*self._pieces, self._escape])))
        runs = {s[at : at + RUN] for s in given for at in range(max(1, len(s) - RUN + 1))}
        # Each run wherever it begins; of a short secret, which may begin a run, there is one alone.
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
        """Yield where secrets begin and end in a text, and in what its escapes stand for."""
        if any(piece in text for piece in self._pieces):
            yield from (match.span(1) for match in self._runs.finditer(text))
        if nested and self._escape in text:
            found = [*self._spans(ESCAPE.sub(unescaped, text), nested - 1)]
            at = places(text) if found else int
            yield from ((at(begin), at(end)) for begin, end in found)


def unescaped(escape: re.Match[str]) -> str:
    """Return the character that an escape of JSON stands for."""
    code, letter = escape.groups()
    return chr(int(code, 16)) if code else CONTROLS.get(letter, letter)


def places(text: str) -> Callable[[int], int]:
    """Return the function from a place in an unescaped text to the same place in the text."""
    begins, longer = [], [0]
    for escape in ESCAPE.finditer(text):
        begins.append(escape.start() - longer[-1])
        longer.append(longer[-1] + len(escape[0]) - 1)
    return lambda place: place + longer[bisect_left(begins, place)]
