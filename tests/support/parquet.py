"""Writes Parquet files by hand, with pages and a footer that no library would write."""

from __future__ import annotations

from itertools import pairwise

from merge_runner.results.recording import COLUMNS

I32, I64, BINARY, LIST, STRUCT = 5, 6, 8, 9, 12
PLAIN, RLE, DELTA_BYTE_ARRAY, RLE_DICTIONARY = 0, 3, 7, 8
UNCOMPRESSED, ZSTD = 0, 6
DATA, DICTIONARY = 0, 2
FRAME = bytes.fromhex("28b52ffda0")
"""Begins what zstd has packed in one segment; four bytes with its size follow."""


def varint(value):
    encoded = bytearray()
    while value >= 0x80:
        encoded.append(value & 0x7F | 0x80)
        value >>= 7
    return bytes(encoded) + bytes([value])


def zigzag(value):
    return varint(value << 1 if value >= 0 else -2 * value - 1)


def text(value):
    raw = value.encode()
    return varint(len(raw)) + raw


def items(kind, values):
    return bytes([0xF0 | kind]) + varint(len(values)) + b"".join(values)


def struct(*fields):
    """A struct in Thrift's compact form, of (number, kind, encoded value)."""
    encoded, before = b"", 0
    for number, kind, value in fields:
        encoded += bytes([number - before << 4 | kind]) + value
        before = number
    return encoded + b"\0"


def page(kind, values, packed, size, encoding=PLAIN):
    """A page of so many values, whose packed bytes unpack to this size."""
    own = [(1, I32, zigzag(values)), (2, I32, zigzag(encoding))]
    if kind == DATA:
        own += [(3, I32, zigzag(RLE)), (4, I32, zigzag(RLE))]
    header = [(1, I32, zigzag(kind)), (2, I32, zigzag(size)), (3, I32, zigzag(len(packed)))]
    return struct(*header, ({DATA: 5, DICTIONARY: 7}[kind], STRUCT, struct(*own))) + packed


def zeros(size):
    """So many zeros in the form of zstd: four bytes for each 128 KB of them."""
    blocks, most = b"", 2**17
    for at in range(0, size, most):
        now = min(most, size - at)
        is_last = at + now == size
        blocks += (now << 3 | 1 << 1 | is_last).to_bytes(3, "little") + b"\0"
    return FRAME + size.to_bytes(4, "little") + blocks


def stored(raw):
    """A few bytes in the form of zstd."""
    return FRAME + len(raw).to_bytes(4, "little") + (len(raw) << 3 | 1).to_bytes(3, "little") + raw


def dictionary(entries):
    """A column of one value, whose dictionary has so many empty texts."""
    place = bytes([1]) + varint(1 << 1) + bytes(1)  # of one bit; once; the first
    return ZSTD, (
        page(DICTIONARY, entries, zeros(4 * entries), 4 * entries)
        + page(DATA, 1, stored(place), len(place), RLE_DICTIONARY)
    )


def deltas(values):
    """Whole numbers in the form of DELTA_BINARY_PACKED, each difference in four bytes."""
    encoded = varint(128) + varint(4) + varint(len(values)) + zigzag(values[0])
    steps = [after - before for before, after in pairwise(values)]
    for at in range(0, len(steps), 128):
        block = steps[at : at + 128]
        encoded += zigzag(least := min(block)) + bytes([32] * 4)
        block += [least] * (-len(block) % 32)
        encoded += b"".join((step - least).to_bytes(4, "little") for step in block)
    return encoded


def prefixes(length, values):
    """A column of values that are each the one before, a text of this length."""
    lengths = deltas([0] + [length] * (values - 1)) + deltas([length] + [0] * (values - 1))
    raw = lengths + b"x" * length
    return UNCOMPRESSED, page(DATA, values, raw, len(raw), DELTA_BYTE_ARRAY)


def write(file, rows, pages, metadata):
    """Write one row group of a recording's columns; ``pages`` are (codec, bytes) by column.

    All others hold nothing but empty texts and zeros.
    """
    content, chunks = b"PAR1", []
    for name, kind in COLUMNS.items():
        raw = bytes(rows * (4 if kind == "VARCHAR" else 8))
        codec, packed = pages.get(name, (UNCOMPRESSED, page(DATA, rows, raw, len(raw))))
        meta = struct(
            (1, I32, zigzag(6 if kind == "VARCHAR" else 2)),
            (2, LIST, items(I32, [zigzag(PLAIN)])),
            (3, LIST, items(BINARY, [text(name)])),
            (4, I32, zigzag(codec)),
            (5, I64, zigzag(rows)),
            (6, I64, zigzag(len(packed))),
            (7, I64, zigzag(len(packed))),
            (9, I64, zigzag(len(content))),
        )
        chunks.append(struct((2, I64, zigzag(len(content))), (3, STRUCT, meta)))
        content += packed
    root = struct((4, BINARY, text("schema")), (5, I32, zigzag(len(COLUMNS))))
    leaves = [
        struct(
            (1, I32, zigzag(6 if kind == "VARCHAR" else 2)),
            (3, I32, zigzag(0)),
            (4, BINARY, text(name)),
            *([(6, I32, zigzag(0))] if kind == "VARCHAR" else []),
        )
        for name, kind in COLUMNS.items()
    ]
    group = struct(
        (1, LIST, items(STRUCT, chunks)), (2, I64, zigzag(len(content))), (3, I64, zigzag(rows))
    )
    pairs = [struct((1, BINARY, text(key)), (2, BINARY, text(value))) for key, value in metadata]
    footer = struct(
        (1, I32, zigzag(1)),
        (2, LIST, items(STRUCT, [root, *leaves])),
        (3, I64, zigzag(rows)),
        (4, LIST, items(STRUCT, [group])),
        (5, LIST, items(STRUCT, pairs)),
    )
    file.write_bytes(content + footer + len(footer).to_bytes(4, "little") + b"PAR1")
    return file
