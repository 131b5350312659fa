"""Unpacked size of a Parquet file, read from its page headers before any page is decoded.

DuckDB's memory limit covers a page's bytes, but neither the entries of a dictionary nor the output
of a delta encoding. A reader follows each page's own header, so that the footer is no bound.
"""

from __future__ import annotations

import mmap
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import groupby
from operator import itemgetter
from pathlib import Path
from typing import Any

import duckdb

CHUNKS = """
SELECT row_group_id, row_group_num_rows, num_values, total_compressed_size,
    -- DuckDB reads the pages one after the other from here.
    if(dictionary_page_offset >= 4, dictionary_page_offset, data_page_offset)
FROM parquet_metadata({}) ORDER BY row_group_id
"""
# Memory of a dictionary entry: in the page, and its share of a query.
BYTES_OF_ENTRY = 64
# Kinds of pages.
DATA, DICTIONARY, DATA_2 = 0, 2, 3
# Encodings in which each value has its own bytes, or is one of a dictionary.
PLAIN, PLAIN_DICTIONARY, RLE_DICTIONARY = 0, 2, 8
# Kinds of fields in Thrift's compact protocol.
TRUE, FALSE, I32, I64, BINARY, STRUCT = 1, 2, 5, 6, 8, 12
DEEPEST = 4
Fields = dict[tuple[int, int], Any]
"""Field values by (number, kind)."""


@dataclass(frozen=True, slots=True)
class Page:
    """Page by its header: unpacked bytes, number of values, offset of its end."""

    is_dictionary: bool
    size: int
    values: int
    end: int


def group_bytes(file: Path, pattern: str, connection: duckdb.DuckDBPyConnection) -> Iterator[int]:
    """Yield an upper bound of the bytes to decode each row group, over all columns.

    ``pattern`` names the file in SQL. A reader holds the dictionary and one page of each column.
    Raises ValueError for pages that contradict the footer, or have an encoding that can unpack to
    more than the header says.
    """
    chunks = connection.execute(CHUNKS.format(pattern)).fetchall()
    with file.open("rb") as stream, mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ) as data:
        if sum(packed for *_, packed, _ in chunks) > len(data):
            raise ValueError("its columns overlap")
        for _, group in groupby(chunks, itemgetter(0)):
            yield sum(_chunk_bytes(data, *chunk[1:]) for chunk in group)


def _chunk_bytes(data: mmap.mmap, rows: int, values: int, packed: int, start: int) -> int:
    """Return an upper bound of the bytes to decode a column of a row group."""
    at, end, seen, dictionary, largest = start, start + packed, 0, 0, 0
    while at < end:
        page = _page(data, at)
        if page.is_dictionary:
            if page.values > rows:
                raise ValueError("a dictionary has more entries than its column has values")
            dictionary += page.size + page.values * BYTES_OF_ENTRY
        else:
            seen, largest = seen + page.values, max(largest, page.size)
        at = page.end
    if at != end or not seen == values == rows:
        raise ValueError("its pages are not as its footer says")
    return dictionary + largest


def _page(data: mmap.mmap, at: int) -> Page:
    try:
        header, at = _struct(data, at)
        kind, size, packed = (header[number, I32] for number in (1, 2, 3))
        # By page kind: the field with its own header, and the encoding's field in that header.
        field, encoded = {DATA: (5, 2), DICTIONARY: (7, 2), DATA_2: (8, 4)}[kind]
        values, encoding = header[field, STRUCT][1, I32], header[field, STRUCT][encoded, I32]
    except (KeyError, IndexError) as exc:
        raise ValueError("a page's header is damaged") from exc
    if encoding not in (PLAIN, PLAIN_DICTIONARY, RLE_DICTIONARY):
        raise ValueError(f"a column has encoding {encoding}, which no export writes")
    if min(size, packed, values) < 0:
        raise ValueError("a page has a negative size")
    return Page(kind == DICTIONARY, size, values, at + packed)


def _struct(data: mmap.mmap, at: int, depth: int = 0) -> tuple[Fields, int]:
    """Read a struct in Thrift's compact protocol; return its fields and the offset of its end.

    Ambiguous content, such as a repeated field, raises ValueError.
    """
    fields: Fields = {}
    number = 0
    value: Any
    while byte := data[at]:
        step, kind = divmod(byte, 16)
        number, at = number + step, at + 1
        if not step or depth > DEEPEST:
            raise ValueError("a page's header is none that an export writes")
        if kind == STRUCT:
            value, at = _struct(data, at, depth + 1)
        elif kind in (I32, I64):
            value, at = _number(data, at)
            value = value >> 1 ^ -(value & 1)
            if kind == I32 and not -(2**31) <= value < 2**31:
                raise ValueError("a page's header has a number that is too large")
        elif kind == BINARY:
            length, at = _number(data, at)
            value, at = None, at + length
        elif kind not in (TRUE, FALSE):
            raise ValueError("a page's header is none that an export writes")
        fields[number, kind] = value
    return fields, at + 1


def _number(data: mmap.mmap, at: int) -> tuple[int, int]:
    """Read a variable-length integer; return it and the offset of its end."""
    value = shift = 0
    while (byte := data[at]) & 0x80:
        value, shift, at = value | (byte & 0x7F) << shift, shift + 7, at + 1
        if shift > 63:
            raise ValueError("a page's header has a number that is too large")
    return value | byte << shift, at + 1
