"""Takes secrets out of what a server echoes."""

from __future__ import annotations

import re
from collections.abc import Iterable

MASK = "[key]"
# So many characters of a secret in a row are masked, too. Wherever they begin in it, they contain
# one of its pieces, each half as long.
RUN = 12
PIECE = RUN // 2


class Mask:
    """Replaces secrets, and RUN characters of one in a row or more, in texts."""

    def __init__(self, secrets: Iterable[str]) -> None:
        # The longest first, since one may hold another.
        self._pieces = {
            secret: [secret[at : at + PIECE] for at in range(0, len(secret) - PIECE + 1, PIECE)]
            for secret in sorted(secrets, key=len, reverse=True)
        }

    def __call__(self, text: str) -> str:
        """The text without the secrets."""
        for secret, pieces in self._pieces.items():
            if any(piece in text for piece in pieces):
                text = _without_runs(text.replace(secret, MASK), secret)
        return text


def _without_runs(text: str, secret: str) -> str:
    runs = {re.escape(secret[at : at + RUN]) for at in range(len(secret) - RUN + 1)}
    spans = sorted(match.span() for run in runs for match in re.finditer(run, text))
    kept, done = [], 0
    for begin, end in spans:
        if begin >= done:
            kept += [text[done:begin], MASK]
        done = max(done, end)
    return "".join([*kept, text[done:]])
