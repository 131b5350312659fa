"""The process in which a query runs, or a copy is made: the explorer may kill it at any moment.

The rows of a page are in the line of JSON of its answer, a CSV follows it.
"""

from __future__ import annotations

import contextlib
import io
import json
import os
import shutil
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from datetime import datetime
from decimal import Decimal
from pathlib import Path
from typing import Any

import duckdb

from analysis.explorer.child import Answer, serve
from merge_runner.errors import MergeRunnerError
from merge_runner.results.database import Instance, read_database
from merge_runner.results.store import answering
from merge_runner.text_safety import csv_writer, in_spreadsheet, quoted

# Python and DuckDB reserve more addresses than they use; a query's memory comes on top.
ADDRESSES_MB = 1024
THREADS = 2
BATCH = 64  # rows fetched at once: each may be large
COLUMNS = 1000
NAME = 200
PLAN_TEXT = 400_000
CELL_COSTS = 30  # bytes of a cell of the page, beside its text
LOGS = (".wal", ".wal.checkpoint", ".wal.recovery")
# What Python gets for infinite timestamps.
INFINITE = {"9999-12-31 23:59:59.999999": "infinity", "0001-01-01 00:00:00": "-infinity"}


@dataclass(frozen=True, slots=True)
class Caps:
    """What a query may take, and how much of its result is shown."""

    seconds: float = 10.0
    memory_mb: int = 512
    rows: int = 1_000
    text: int = 2_000
    """Characters of a cell of a page."""
    size: int = 5_000_000
    """Bytes."""


@dataclass(frozen=True, slots=True)
class Query:
    """What is to be run, on which open file, and how much may come of it."""

    file: str
    sql: str
    as_csv: bool
    caps: Caps


def answer(told: dict[str, Any]) -> Answer:
    """Make a copy or run a query: what is told are the fields of the one or the other."""
    if "copy" in told:
        return _copy(Path(told["database"]), Path(told["copy"])), b""
    query = Query(**{**told, "caps": Caps(**told["caps"])})
    try:
        return _run(query)
    # Python has no values for some of DuckDB's, such as intervals of millions of years.
    except (MergeRunnerError, duckdb.Error, OSError, MemoryError, OverflowError, ValueError) as exc:
        memory = (MemoryError, duckdb.OutOfMemoryException)
        if isinstance(exc, memory) or isinstance(exc.__cause__, memory):
            return {"error": f"the query needed more than {query.caps.memory_mb} MB"}, b""
        return {"error": _one_line(exc)}, b""


def _copy(database: Path, copy: Path) -> dict[str, Any]:
    """Copy a database to a new file while it is open for reading here, so that nobody writes."""
    try:
        with read_database(database, Instance()):
            # The database last: a process that closes a file loses all its locks on it.
            for log in LOGS:
                with contextlib.suppress(FileNotFoundError):
                    shutil.copyfile(f"{database}{log}", f"{copy}{log}")
            shutil.copyfile(database, copy)
        with duckdb.connect(copy) as whole:  # the copy loses its name, and its log with it
            whole.execute("CHECKPOINT")
    except (MergeRunnerError, duckdb.Error, OSError) as exc:
        text = _one_line(exc)
        # Where the files lie is not for everybody who may ask.
        for path in (database, copy):
            text = text.replace(f"{path.parent}{os.sep}", "")
        return {"error": text}
    return {}


def _run(query: Query) -> Answer:
    _confine(query.caps)
    began = time.monotonic()
    with _opened(query) as connection, answering(connection, query.sql) as result:
        columns = [(name, str(kind)) for name, kind, *_ in result.description or ()]
        rows = _fetched(result)
        if query.as_csv:
            return _csv([name for name, _ in columns], rows, query.caps)
        if len(columns) > COLUMNS:
            return {"error": f"the result has more than {COLUMNS} columns: name those to show"}, b""
        is_plan = bool(columns) and columns[0][0] == "explain_key"
        caps = replace(query.caps, text=PLAN_TEXT) if is_plan else query.caps
        cells, more = _cells(rows, caps)
    names = [[name[:NAME], kind[:NAME]] for name, kind in columns]
    seconds = time.monotonic() - began
    return {"columns": names, "rows": cells, "more": more, "seconds": seconds}, b""


@contextlib.contextmanager
def _opened(query: Query) -> Iterator[duckdb.DuckDBPyConnection]:
    """The database under a name of ours: the file has none, and is opened as ``/dev/fd/N``."""
    config: dict[str, str | bool | int | float | list[str]] = {
        "memory_limit": f"{query.caps.memory_mb}MB",
        "threads": THREADS,
        "temp_directory": "",
        "python_enable_replacements": False,
    }
    with duckdb.connect(config=config) as connection:
        connection.execute(f"ATTACH {quoted(query.file)} AS results (READ_ONLY); USE results")
        yield connection


def _confine(caps: Caps) -> None:
    """Limit what the process may use, where the system can do so."""
    try:
        import resource
    except ImportError:
        return
    for kind, most in (
        (resource.RLIMIT_AS, (caps.memory_mb + ADDRESSES_MB) << 20),
        (resource.RLIMIT_FSIZE, 0),
        (resource.RLIMIT_CORE, 0),
    ):
        with contextlib.suppress(ValueError, OSError):
            resource.setrlimit(kind, (most, most))


def _fetched(result: duckdb.DuckDBPyConnection) -> Iterator[tuple[Any, ...]]:
    while batch := result.fetchmany(BATCH):
        yield from batch


def _cells(
    rows: Iterator[tuple[Any, ...]], caps: Caps
) -> tuple[list[list[tuple[str, int] | None]], bool]:
    """The first rows, and whether there are more. A cell: its text, and how much is left out."""
    cells: list[list[tuple[str, int] | None]] = []
    size = 0
    for row in rows:
        texts = [text_of(value) for value in row]
        line = [
            None if text is None else (text[: caps.text], max(0, len(text) - caps.text))
            for text in texts
        ]
        size += sum(CELL_COSTS + (len(cell[0].encode()) if cell else 0) for cell in line)
        if len(cells) == caps.rows or size > caps.size:
            return cells, True
        cells.append(line)
    return cells, False


def _csv(names: list[str], rows: Iterator[tuple[Any, ...]], caps: Caps) -> Answer:
    content, lines = io.BytesIO(), io.StringIO()
    writer = csv_writer(lines)
    writer.writerow(map(in_spreadsheet, names))
    for number, row in enumerate(rows):
        writer.writerow(map(csv_cell, row))
        content.write(lines.getvalue().encode())
        lines.seek(0)
        lines.truncate()
        if number == caps.rows or content.tell() > caps.size:
            # A file that ends early would be taken for the whole.
            return {
                "error": f"a download holds up to {caps.rows:,} rows and "
                f"{caps.size / 1e6:.0f} MB, and this result has more: narrow the query, or use "
                "`merge-runner sql --format csv`"
            }, b""
    content.write(lines.getvalue().encode())  # the names, where there is no row
    return {}, content.getvalue()


def csv_cell(value: object) -> object:
    """A value of any type for a cell of CSV."""
    text = text_of(value)
    return text if isinstance(value, int | float | Decimal) else in_spreadsheet(text)


def text_of(value: object) -> str | None:
    """A value of any type as a text; None for NULL."""
    match value:
        case None | str():
            return value
        case bool():
            return "true" if value else "false"
        case bytes():
            return f"0x{value.hex()}"
        case datetime():
            text = value.isoformat(" ")
            return INFINITE.get(text, text)
        case list() | tuple() | dict():
            return json.dumps(_plain(value), ensure_ascii=False)
        case _:
            return str(value)


def _plain(value: object) -> object:
    """A nested value as JSON can say it."""
    match value:
        case list() | tuple():
            return [_plain(item) for item in value]
        case dict():
            return {str(text_of(key)): _plain(item) for key, item in value.items()}
        case bool() | int() | float():
            return value
        case _:
            return text_of(value)


def _one_line(exc: BaseException) -> str:
    """What an error says, without the query and the stack that DuckDB adds below."""
    text, _, _ = str(exc).partition("\n\n")
    return " ".join(text.partition("\nLINE ")[0].split())[:1000]


if __name__ == "__main__":
    serve(answer)
