"""Runs a reader's query on a copy of the database: one that only reads, within limits."""

from __future__ import annotations

import io
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Any

import duckdb

from merge_runner.errors import MergeRunnerError, UsageError
from merge_runner.results.database import SETTINGS, fetched, in_memory
from merge_runner.results.store import answering
from merge_runner.text_safety import csv_writer, first_line, in_spreadsheet
from merge_runner_analysis.explorer.database_copy import Copies
from merge_runner_analysis.explorer.display_text import csv_cell, text_of

AT_ONCE = 2
WAITING = 8  # beside those that run: each keeps a thread of the server
PATIENCE_S = 20.0
LONGEST = 10_000  # characters of a query
DOWNLOADED_ROWS = 100_000
DOWNLOADED_BYTES = 50_000_000
COLUMNS = 1000
NAME = 200  # characters of the name or type of a column
PLAN_TEXT = 400_000
CELL_COSTS = 30  # bytes of a cell of the page, beside its text
AGAIN_S = 0.1  # a query that is about to begin forgets that it was to end

Cell = tuple[str, int] | None
"""A text, and how many of its characters are left out; None is NULL."""


@dataclass(frozen=True, slots=True)
class Limits:
    """What a query may take, and how much of its result is shown.

    ``text`` are characters of a cell, ``size`` bytes of the result.
    """

    seconds: float = 10.0
    memory_mb: int = 512
    rows: int = 1_000
    text: int = 2_000
    size: int = 5_000_000


@dataclass(frozen=True, slots=True)
class QueryResult:
    """What a query found: names and types of columns, and rows; with ``more`` there are others."""

    columns: list[tuple[str, str]]
    rows: list[list[Cell]]
    more: bool
    seconds: float


class Queries:
    """Runs queries on one database."""

    def __init__(
        self, copies: Copies, limits: Limits | None = None, patience_s: float = PATIENCE_S
    ) -> None:
        self._copies = copies
        self.limits = limits or Limits()
        self._patience_s = patience_s
        self._turns = threading.Semaphore(AT_ONCE)
        self._places = threading.Semaphore(AT_ONCE + WAITING)

    def result(self, sql: str) -> QueryResult:
        """What a query finds, as much of it as is shown; raises UsageError."""
        began = time.monotonic()
        with self._answering(sql) as found:
            columns = [(name[:NAME], str(kind)[:NAME]) for name, kind, *_ in found.description]
            if len(columns) > COLUMNS:
                raise UsageError(f"the result has more than {COLUMNS} columns: name those to show")
            is_plan = bool(columns) and columns[0][0] == "explain_key"
            limits = replace(self.limits, text=PLAN_TEXT) if is_plan else self.limits
            rows, more = _cells(fetched(found), limits)
        return QueryResult(columns, rows, more, time.monotonic() - began)

    def csv(self, sql: str) -> bytes:
        """All that a query finds; raises UsageError, also where it is more than a download holds.

        A file that ended early would be taken for the whole.
        """
        content, lines = io.BytesIO(), io.StringIO()
        writer = csv_writer(lines)
        with self._answering(sql) as found:
            writer.writerow(in_spreadsheet(name) for name, *_ in found.description)
            for number, row in enumerate(fetched(found), start=1):
                writer.writerow(map(csv_cell, row))
                content.write(lines.getvalue().encode())
                lines.seek(0)
                lines.truncate()
                if number > DOWNLOADED_ROWS or content.tell() > DOWNLOADED_BYTES:
                    raise UsageError(
                        f"a download holds up to {DOWNLOADED_ROWS:,} rows and "
                        f"{DOWNLOADED_BYTES / 1e6:.0f} MB, and this result has more: narrow the "
                        "query, or use `merge-runner sql --format csv`"
                    )
        content.write(lines.getvalue().encode())  # the names, where there is no row
        return content.getvalue()

    @contextmanager
    def _answering(self, sql: str) -> Iterator[duckdb.DuckDBPyConnection]:
        """Run a query, to be fetched; raises UsageError."""
        if len(sql) > LONGEST:
            raise UsageError(
                f"a query has up to {LONGEST:,} characters here, this one {len(sql):,}"
            )
        settings = {**SETTINGS, "memory_limit": f"{self.limits.memory_mb}MB"}
        # An instance of its own, which stays restricted.
        with self._turn(), in_memory(settings) as connection:
            copy = self._copies.current()
            connection.execute(f"ATTACH {copy.file} AS results (READ_ONLY); USE results")
            ended, late = threading.Event(), threading.Event()

            def stop() -> None:
                if not ended.wait(self.limits.seconds):
                    late.set()
                while not ended.wait(AGAIN_S):
                    connection.interrupt()

            threading.Thread(target=stop, daemon=True).start()
            try:
                with answering(connection, sql) as found:
                    yield found
            # Python has no values for some of DuckDB's, such as intervals of millions of years.
            except (MergeRunnerError, duckdb.Error, OverflowError, ValueError) as exc:
                if late.is_set():
                    raise UsageError(f"stopped after {self.limits.seconds:g} s") from exc
                if isinstance(exc.__cause__ or exc, duckdb.OutOfMemoryException):
                    raise UsageError(
                        f"the query needed more than {self.limits.memory_mb} MB"
                    ) from exc
                raise UsageError(first_line(exc)) from exc
            finally:
                ended.set()

    @contextmanager
    def _turn(self) -> Iterator[None]:
        # Counted apart from the turns, so that whoever is one too many hears it at once.
        if not self._places.acquire(blocking=False):
            raise UsageError("too many queries are waiting: run it again in a moment")
        try:
            if not self._turns.acquire(timeout=self._patience_s):
                raise UsageError(
                    f"{AT_ONCE} other queries are running, and none ended within "
                    f"{self._patience_s:g} s: run it again in a moment"
                )
            try:
                yield
            finally:
                self._turns.release()
        finally:
            self._places.release()


def _cells(rows: Iterator[tuple[Any, ...]], limits: Limits) -> tuple[list[list[Cell]], bool]:
    """The first rows, and whether there are more."""
    cells: list[list[Cell]] = []
    size = 0
    for row in rows:
        texts = [text_of(value) for value in row]
        line = [
            None if text is None else (text[: limits.text], max(0, len(text) - limits.text))
            for text in texts
        ]
        size += sum(CELL_COSTS + (len(cell[0].encode()) if cell else 0) for cell in line)
        if len(cells) == limits.rows or size > limits.size:
            return cells, True
        cells.append(line)
    return cells, False
