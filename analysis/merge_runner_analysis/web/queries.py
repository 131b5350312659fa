"""Runs a reader's query on a copy of the database: one that only reads, within limits."""

from __future__ import annotations

import io
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import duckdb

from merge_runner.errors import MergeRunnerError, UsageError
from merge_runner.results.database import fetched
from merge_runner.results.instance import SETTINGS, in_memory
from merge_runner.results.store import run_restricted
from merge_runner.text_safety import csv_writer, in_spreadsheet
from merge_runner_analysis.web.display_text import csv_cell, text_of
from merge_runner_analysis.web.reading import Copies

AT_ONCE = 2
WAITING = 8  # in addition to those that run: each keeps a thread of the server
LONGEST_S = 10.0
LONGEST = 10_000  # characters of a query
MEMORY_MB = 512
# Shown of a result: rows, characters of a cell, and of all cells with what each costs.
ROWS, TEXT, SIZE, CELL_COSTS = 1_000, 2_000, 5_000_000, 30
DOWNLOADED_ROWS, DOWNLOADED = 100_000, 50_000_000  # the second are characters
AGAIN_S = 0.1  # a query that is about to begin forgets that it was to end

Cell = tuple[str, int] | None
"""A text, and how many of its characters are left out; None is NULL."""


@dataclass(frozen=True, slots=True)
class QueryResult:
    """Result of a query: names and types of columns, and rows; with ``more`` it is cut."""

    columns: list[tuple[str, str]]
    rows: list[list[Cell]]
    more: bool
    seconds: float


class Queries:
    """Runner of queries on one database, each for ``longest_s`` at most."""

    def __init__(self, copies: Copies, longest_s: float = LONGEST_S) -> None:
        self._copies = copies
        self.longest_s = longest_s
        self._turns = threading.Semaphore(AT_ONCE)
        self._places = threading.Semaphore(AT_ONCE + WAITING)

    def result(self, sql: str) -> QueryResult:
        """Return the result of a query, as much of it as is shown; raises UsageError."""
        began, size, rows = time.monotonic(), 0, list[list[Cell]]()
        with self._answering(sql) as cursor:
            columns = [(name, str(kind)) for name, kind, *_ in cursor.description]
            more = False
            for row in fetched(cursor):
                texts = map(text_of, row)
                cells = [t if t is None else (t[:TEXT], max(0, len(t) - TEXT)) for t in texts]
                size += sum(CELL_COSTS + len(cell[0] if cell else "") for cell in cells)
                more = len(rows) == ROWS or size > SIZE
                if more:
                    break
                rows.append(cells)
        return QueryResult(columns, rows, more, time.monotonic() - began)

    def csv(self, sql: str) -> str:
        """Return the whole result of a query; raises UsageError, also where it is too large.

        A file that ended early would be taken for the whole.
        """
        lines = io.StringIO()
        writer = csv_writer(lines)
        with self._answering(sql) as cursor:
            writer.writerow(in_spreadsheet(name) for name, *_ in cursor.description)
            for number, row in enumerate(fetched(cursor), start=1):
                writer.writerow(map(csv_cell, row))
                if number > DOWNLOADED_ROWS or lines.tell() > DOWNLOADED:
                    raise UsageError(
                        f"a download holds up to {DOWNLOADED_ROWS:,} rows and {DOWNLOADED:,} "
                        "characters, and this result has more: narrow the query, or use "
                        "`merge-runner sql --format csv`"
                    )
        return lines.getvalue()

    @contextmanager
    def _answering(self, sql: str) -> Iterator[duckdb.DuckDBPyConnection]:
        if len(sql) > LONGEST:
            raise UsageError(
                f"a query has up to {LONGEST:,} characters here, this one {len(sql):,}"
            )
        settings = {**SETTINGS, "memory_limit": f"{MEMORY_MB}MB"}
        # An instance of its own, which stays restricted.
        with self._turn(), in_memory(settings) as connection:
            copy = self._copies.current()
            connection.execute(f"ATTACH {copy.file} AS results (READ_ONLY); USE results")
            ended, late = threading.Event(), threading.Event()

            def stop() -> None:
                if not ended.wait(self.longest_s):
                    late.set()
                while not ended.wait(AGAIN_S):
                    connection.interrupt()

            threading.Thread(target=stop, daemon=True).start()
            try:
                with run_restricted(connection, sql) as cursor:
                    yield cursor
            # Python has no values for some of DuckDB's, such as intervals of millions of years.
            except (MergeRunnerError, duckdb.Error, OverflowError, ValueError) as exc:
                # With the candidates and the place that DuckDB names, without its stack trace.
                message = str(exc).partition("\n\nStack Trace")[0].strip()
                if isinstance(exc.__cause__ or exc, duckdb.OutOfMemoryException):
                    message = f"the query needed more than {MEMORY_MB} MB"
                if late.is_set():
                    message = f"stopped after {self.longest_s:g} s"
                raise UsageError(message) from exc
            finally:
                ended.set()

    @contextmanager
    def _turn(self) -> Iterator[None]:
        # Counted apart from the turns, so that whoever is one too many hears it at once.
        if not self._places.acquire(blocking=False):
            raise UsageError("too many queries are waiting: run it again in a moment")
        try:
            with self._turns:
                yield
        finally:
            self._places.release()
