"""Reads the body of a reply within bounds: of its size, also unpacked, and of its nesting."""

from __future__ import annotations

import asyncio
import re
import zlib
from collections.abc import AsyncIterator
from itertools import accumulate

from merge_runner.llm.transport import TransportFailure

# What is asked for.
ENCODING = "gzip"
PIECE = 2**18
# No provider's reply has ten levels, and each program that reads one has a limit of its own.
MOST_LEVELS = 100
MOST_VALUES = 1_000_000
# One that may be longer may hold more values in proportion.
BYTES_PER_VALUE = 16
# Strings, in which brackets are none, and all other characters.
_NO_BRACKETS = re.compile(r'"[^"]*"|[^][{}"]+')


async def read_body(chunks: AsyncIterator[bytes], encoding: str, most_bytes: int) -> str:
    """The text of a body that comes in chunks; raises TransportFailure.

    It is read as UTF-8, the encoding of JSON, whatever a header says.
    """
    pieces, size = [], 0
    async for piece in _unpacked(chunks, encoding):
        size += len(piece)
        if size > most_bytes:
            raise refused(_too_long(most_bytes))
        pieces.append(piece)
    text = _decoded(pieces)
    if why := _why_refused(text, most_bytes):
        raise refused(why)
    return text


async def read_lines(
    chunks: AsyncIterator[bytes], encoding: str, most_bytes: int
) -> AsyncIterator[str | TransportFailure]:
    """The lines of a body that comes in chunks, or why one is refused; empty ones are left out.

    Each is held to the bounds of a whole body. Raises TransportFailure where there is no going on.
    """
    pieces: list[bytes] = []
    size = 0
    async for chunk in _unpacked(chunks, encoding):
        *ends, begun = chunk.split(b"\n")
        for end in ends:
            pieces.append(end)
            if line := _line(pieces, size + len(end), most_bytes):
                yield line
            pieces, size = [], 0
        size += len(begun)
        if size <= most_bytes:
            pieces.append(begun)
        else:  # of a line that is too long nothing is kept
            pieces.clear()
    if line := _line(pieces, size, most_bytes):
        yield line


def _line(pieces: list[bytes], size: int, most_bytes: int) -> str | TransportFailure:
    """A line without its end, which may be CRLF, or why it is refused."""
    if size > most_bytes:
        return refused(_too_long(most_bytes))
    text = _decoded(pieces).removesuffix("\r")
    why = _why_refused(text, most_bytes)
    return refused(why) if why else text


def _decoded(pieces: list[bytes]) -> str:
    return b"".join(pieces).decode("utf-8-sig", errors="replace")


def _too_long(most_bytes: int) -> str:
    return f"it is longer than {most_bytes / 1e6:g} MB (max_reply_mb)"


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
        if unpacking.eof and chunk:
            raise refused(f"it goes on after the end of its {encoding}")
        packed = chunk
        while packed:
            try:
                yield unpacking.decompress(packed, PIECE)
            except zlib.error as exc:
                raise TransportFailure("connection_lost", f"the reply is no {encoding}") from exc
            packed = unpacking.unconsumed_tail
            cut = not unpacking.eof
            await asyncio.sleep(0)  # other calls go on while a large body is unpacked
        if unpacking.unused_data:
            raise refused(f"it goes on after the end of its {encoding}")
    if cut:
        raise TransportFailure("connection_lost", f"the reply is cut within its {encoding}")


def _why_refused(text: str, most_bytes: int) -> str | None:
    """Why a text is too much JSON to be read in little time and memory; None if it is not."""
    if text.lstrip()[:1] not in ("[", "{"):
        return None
    most_values = max(MOST_VALUES, most_bytes // BYTES_PER_VALUE)
    if sum(map(text.count, "[{,")) > most_values:
        return f"it holds more than {most_values:,} values"
    if text.count("[") + text.count("{") <= MOST_LEVELS:
        return None
    unescaped = text.replace(r"\\", "").replace(r"\"", "")
    steps = (1 if bracket in "[{" else -1 for bracket in _NO_BRACKETS.sub("", unescaped))
    deepest = max(accumulate(steps), default=0)
    return f"it nests deeper than {MOST_LEVELS} levels" if deepest > MOST_LEVELS else None
