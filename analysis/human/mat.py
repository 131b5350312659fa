"""MAT files of version 5, as far as recordings need them.

Not read with scipy: its reader ends the whole process at some damaged files. The layout is that of
"MAT-File Format" (The MathWorks): elements, each a type, a size in bytes and content.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator

from analysis.human.archive import Unreadable

# A recording has 0.2 MB. What is read becomes Python numbers, up to 32 times as large.
MAX_BYTES = 16 * 2**20
HEADER_BYTES = 128
VERSION_5 = b"\x00\x01IM"
MATRIX, COMPRESSED = 14, 15
CHARACTERS = 4
NUMBERS = {1: "b", 2: "B", 3: "h", 4: "H", 5: "i", 6: "I", 7: "f", 9: "d", 12: "q", 13: "Q"}
TEXTS = {4: "utf-16-le", 16: "utf-8", 17: "utf-16-le"}
DAMAGED = (struct.error, zlib.error, ValueError, IndexError)


def read_mat(content: bytes) -> dict[str, list[float | str]]:
    """Variable to its values; a text is one value, cells and structures have none.

    Raises Unreadable.
    """
    if content[HEADER_BYTES - 4 : HEADER_BYTES] != VERSION_5:
        raise Unreadable("it is not a MAT file of version 5")
    if len(content) > MAX_BYTES:
        raise Unreadable(f"it has {len(content)} bytes, far too large for a recording")
    try:
        elements = _unpacked_elements(memoryview(content)[HEADER_BYTES:])
        return dict(_variable(data) for kind, data in elements if kind == MATRIX)
    except DAMAGED as exc:
        raise Unreadable(f"it is damaged: {exc}") from exc


def _unpacked_elements(data: memoryview) -> Iterator[tuple[int, memoryview]]:
    left = MAX_BYTES
    for kind, content in _elements(data):
        if kind == COMPRESSED:
            unpacked = _unpacked(content, left)
            left -= len(unpacked)
            yield from _elements(unpacked)
        else:
            yield kind, content


def _elements(data: memoryview) -> Iterator[tuple[int, memoryview]]:
    while data:
        kind, size = struct.unpack_from("<II", data)
        start, padding = 8, -size % 8
        if kind >> 16:  # up to 4 bytes stand in the place of the size
            kind, size, start = kind & 0xFFFF, kind >> 16, 4
            padding = 4 - size
        elif kind == COMPRESSED:
            padding = 0
        if len(data) < start + size:
            raise ValueError("an element is cut off")
        yield kind, data[start : start + size]
        data = data[start + size + padding :]


def _unpacked(data: memoryview, most_bytes: int) -> memoryview:
    unpacking = zlib.decompressobj()
    content = unpacking.decompress(data, most_bytes + 1)  # 0 would be no limit
    if not unpacking.eof or len(content) > most_bytes:
        raise ValueError("an element is cut off or far too large")
    return memoryview(content)


def _variable(data: memoryview) -> tuple[str, list[float | str]]:
    """Name and values of a matrix: its flags, its dimensions, its name, its values."""
    (_, flags), _, (_, name), *rest = _elements(data)
    kind, values = rest[0] if rest else (0, memoryview(b""))
    shown = str(name, "latin-1")
    if flags[0] == CHARACTERS:
        return shown, [str(values, TEXTS.get(kind, "latin-1"))]
    if kind not in NUMBERS:
        return shown, []
    return shown, [number for (number,) in struct.iter_unpack(f"<{NUMBERS[kind]}", values)]
