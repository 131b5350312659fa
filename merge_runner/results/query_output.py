"""The rows of a query as a table, CSV or JSON, however many and however long they are."""

from __future__ import annotations

import json
from collections.abc import Iterable
from itertools import chain
from tempfile import TemporaryFile
from typing import Any, TextIO

from merge_runner.errors import UsageError
from merge_runner.text_safety import csv_writer, in_spreadsheet, printable

Rows = Iterable[tuple[Any, ...]]


def write_csv(names: list[str], rows: Rows, out: TextIO) -> None:
    """Write CSV in which a spreadsheet finds no formula to run."""
    csv_writer(out).writerows(map(in_spreadsheet, row) for row in chain((names,), rows))


def write_json(names: list[str], rows: Rows, out: TextIO) -> None:
    """Write an array of objects."""
    if len(set(names)) < len(names):
        twice = next(name for name in names if names.count(name) > 1)
        raise UsageError(f"two columns are named {twice!r}: name them apart with AS")
    before = "["
    for row in rows:
        record = dict(zip(names, row, strict=True))
        text = json.dumps(record, indent=2, default=str, ensure_ascii=False)
        out.write(f"{before}\n  " + printable(text.replace("\n", "\n  ")))
        before = ","
    out.write("[]\n" if before == "[" else "\n]\n")


def write_table(names: list[str], rows: Rows, out: TextIO) -> None:
    """Write columns as wide as their widest cell; rich would hold all rows in memory at once."""
    widths = [0] * len(names)
    with TemporaryFile("w+", encoding="utf-8", errors="surrogatepass") as kept:
        for row in chain((names,), rows):
            cells = ["" if value is None else str(value) for value in row]
            widths = [max(width, len(cell)) for width, cell in zip(widths, cells, strict=True)]
            kept.write(json.dumps(cells) + "\n")
        kept.seek(0)
        for line in kept:
            padded = map(str.ljust, json.loads(line), widths)
            out.write(printable("  ".join(padded).rstrip()) + "\n")
