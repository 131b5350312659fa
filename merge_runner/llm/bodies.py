"""Reads the body of a reply within bounds: its size, also unpacked, and how deep it nests."""

from __future__ import annotations

import asyncio
import re
import zlib
from collections.abc import AsyncIterator

from merge_runner.llm.transport import TransportFailure

# What is asked for; whatever else a server chooses is refused.
ENCODING = "gzip"
PIECE = 2**18
# No provider's reply has ten levels, and each program that reads one has a limit of its own.
MOST_LEVELS = 100
_STRING = re.compile(r'"(?:[^"\\]|\\.)*"', re.S)
_INNERMOST = re.compile(r"\[\]|\{\}")
_NO_BRACKET = {code: None for code in range(128) if chr(code) not in "[]{}"}


async def read_body(chunks: AsyncIterator[bytes], encoding: str, most_bytes: int) -> str:
    """The text of a body that comes in chunks; raises TransportFailure.

    JSON is UTF-8, whatever a header says. Beside the text itself little memory is used, and the
    event loop is never held for longer than a piece takes to unpack.
    """
    pieces, size = [], 0
    async for piece in _unpacked(chunks, encoding):
        size += len(piece)
        if size > most_bytes:
            raise refused(f"it is longer than {most_bytes / 2**20:g} MB (max_reply_mb)")
        pieces.append(piece)
    text = b"".join(pieces).decode(errors="replace")
    if nests_too_deep(text):
        raise refused(f"it nests deeper than {MOST_LEVELS} levels")
    return text


def refused(why: str) -> TransportFailure:
    """The failure of a reply that is not taken, and not asked for again."""
    return TransportFailure("reply_refused", f"the reply is refused: {why}", action="fail")


async def _unpacked(chunks: AsyncIterator[bytes], encoding: str) -> AsyncIterator[bytes]:
    """The pieces of a body without its encoding."""
    encoding = encoding.strip().lower()
    if encoding in ("", "identity"):
        async for chunk in chunks:
            yield chunk
        return
    if encoding not in ("gzip", "x-gzip", "deflate"):
        raise refused(f"it is encoded as {encoding[:40]!r}, which was not asked for")
    unpacking = zlib.decompressobj(wbits=32 + zlib.MAX_WBITS)  # tells gzip from deflate
    cut = False
    async for chunk in chunks:
        packed = chunk
        while packed:
            try:
                yield unpacking.decompress(packed, PIECE)
            except zlib.error as exc:
                raise TransportFailure("connection_lost", f"the reply is no {encoding}") from exc
            packed = unpacking.unconsumed_tail
            cut = not unpacking.eof
            await asyncio.sleep(0)
    if cut:
        raise TransportFailure("connection_lost", f"the reply is cut within its {encoding}")


def nests_too_deep(text: str) -> bool:
    """Whether JSON has more levels than an honest reply; what is no JSON may be either."""
    if text.count("[") + text.count("{") <= MOST_LEVELS:
        return False
    brackets = _STRING.sub("", text).translate(_NO_BRACKET)
    for _ in range(MOST_LEVELS):
        fewer = _INNERMOST.sub("", brackets)
        if fewer == brackets:
            return False  # all gone, or no JSON
        brackets = fewer
    return bool(brackets)
