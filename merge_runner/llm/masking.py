"""Takes a secret out of what a server echoes, however it is spelt."""

from __future__ import annotations

import re
from base64 import b64encode
from collections.abc import Iterable

MASK = "[key]"
# So many characters of a secret in a row are masked, too. Wherever they begin in it, they contain
# one of its pieces, each half as long.
RUN = 12
PIECE = RUN // 2
# Looking for every spelling takes longer than all other reading: only where there is an escape.
_UNSEEN = r"[\x00-\x08\x0b\x0c\x0e-\x1f\x7f\u200b-\u200f\u2060-\u2064\ufeff]"
_ESCAPE = re.compile(rf"\\+(?:/|u00|x)|%(?:25)*[2-7][0-9A-Fa-f]|&(?:amp;)*#|{_UNSEEN}")


class Mask:
    """Replaces secrets in texts.

    They are found as they are; with any of their characters escaped as in JSON (also in JSON within
    JSON), in URLs (also twice) or as numbers in HTML; with invisible characters between (as in
    UTF-16); and within base64, say of ``user:key``. RUN characters of one in a row are found as
    they are.
    """

    def __init__(self, secrets: Iterable[str]) -> None:
        self._secrets = sorted(secrets, key=len, reverse=True)  # one may hold another
        patterns = (f"{_UNSEEN}*".join(map(_spellings, secret)) for secret in self._secrets)
        self._escaped = re.compile("|".join(patterns))
        self._coded = {core for secret in self._secrets for core in _base64_cores(secret)}

    def __call__(self, text: str) -> str:
        """The text without the secrets."""
        for secret in self._secrets:
            text = _without_runs(text.replace(secret, MASK), secret)
        if self._secrets and _ESCAPE.search(text):
            text = self._escaped.sub(MASK, text)
        for core in self._coded:
            if core in text:
                # With the neighbouring characters, which hold the rest of its bits.
                text = re.sub(rf"[\w+/-]?{re.escape(core)}(?:[\w+/-]{{1,2}}=*)?", MASK, text)
        return text


def _without_runs(text: str, secret: str) -> str:
    """The text without what is RUN characters of a secret in a row, or more."""
    spans = []
    for start in range(0, len(secret) - PIECE + 1, PIECE):
        piece = secret[start : start + PIECE]
        at = text.find(piece)
        while at >= 0:
            ahead = _alike(secret[:start][::-1], text[max(0, at - start) : at][::-1])
            behind = _alike(secret[start:], text[at : at + len(secret) - start])
            if ahead + behind >= RUN:
                spans.append((at - ahead, at + behind))
            at = text.find(piece, at + 1)
    kept, done = [], 0
    for begin, end in sorted(spans):
        if begin >= done:
            kept += [text[done:begin], MASK]
        done = max(done, end)
    return "".join([*kept, text[done:]])


def _alike(one: str, other: str) -> int:
    """How many characters two texts have in common from their beginning on."""
    pairs = zip(one, other, strict=False)
    return next((n for n, (a, b) in enumerate(pairs) if a != b), min(len(one), len(other)))


def _spellings(character: str) -> str:
    """A pattern of the ways to write one character of a key, which is printable ASCII."""
    code = ord(character)
    hexadecimal = "".join(f"[{d}{d.upper()}]" if d.isalpha() else d for d in f"{code:02x}")
    slashed = r"\\*/" if character == "/" else re.escape(character)
    return (
        rf"(?:{slashed}|\\+(?:u00|x){hexadecimal}|%(?:25)*{hexadecimal}"
        rf"|(?:&|\\+u0026)(?:amp;)*#(?:0*{code}|[xX]0*{hexadecimal});?)"
    )


def _base64_cores(secret: str) -> Iterable[str]:
    """What the base64 of any text with the secret contains, in both alphabets.

    Base64 codes three bytes at a time, so that a secret begins at one of three places in a group;
    the characters that it shares with its neighbours are left out.
    """
    for before in range(3):
        coded = b64encode(b"\0" * before + secret.encode()).decode()
        core = coded[-(-before * 8 // 6) : (before + len(secret)) * 8 // 6]
        yield from {core, core.replace("+", "-").replace("/", "_"), core.replace("/", r"\/")}
