"""Runs a user's query in a process that can be killed, on a copy of the database.

The database is open only while it is copied, so that a sweep can write while a query takes long.
A copy lasts as long as the file stays as it is.
"""

from __future__ import annotations

import os
import shutil
import tempfile
import threading
import weakref
from collections.abc import Iterator
from contextlib import closing, contextmanager
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path

from analysis.explorer.catalogue import stamp_of
from analysis.explorer.child import Answer, Child, Ended, NoAnswer
from analysis.explorer.query_worker import Caps, Query
from merge_runner.paths import PROJECT

AT_ONCE = 2
WAITING = 8  # beside those that run: each keeps a thread of the server
PATIENCE_S = 20.0
COPYING_S = 60.0
LONGEST = 10_000  # characters of a query
DOWNLOADED_ROWS = 100_000
DOWNLOADED_BYTES = 50_000_000
SAID_BYTES = 1_000_000  # of errors, and around a result


@dataclass(frozen=True, slots=True)
class QueryResult:
    """What a query found: names and types of columns, and texts; None is NULL.

    A text comes with how many of its characters are left out. With ``more`` there are more rows.
    """

    columns: list[tuple[str, str]]
    rows: list[list[tuple[str, int] | None]]
    more: bool
    seconds: float


class Copy:
    """A copy of a database as an open file without a name: it is gone when nobody holds it.

    So nothing is left of it when the program is killed, and no query can say where it lies.
    """

    def __init__(self, db: Path, stamp: tuple[int, ...]) -> None:
        """Make it; raises NoAnswer."""
        self.stamp = stamp
        try:
            folder = tempfile.mkdtemp(prefix="merge-runner-view-")
        except OSError as exc:
            raise NoAnswer(f"there is no room for a copy of the database: {exc.strerror}") from exc
        try:
            copy = f"{folder}/results.duckdb"
            self._make({"database": str(db.resolve()), "copy": copy})
            self.fd = os.open(copy, os.O_RDONLY)
        finally:
            shutil.rmtree(folder, ignore_errors=True)
        weakref.finalize(self, os.close, self.fd)

    def _make(self, job: dict[str, str]) -> None:
        with closing(_worker()) as worker:
            try:
                worker.ask(job, seconds=COPYING_S, most_bytes=SAID_BYTES)
            except Ended as exc:
                if exc.late:
                    why = "the database could not be copied in a minute: is it being written?"
                else:
                    why = f"the copy of the database failed: {exc}"
                raise NoAnswer(why) from exc


@dataclass
class Sandbox:
    """Runs queries on one database: a few at once, each in its process and within its caps."""

    db: Path
    caps: Caps = field(default_factory=Caps)
    patience_s: float = PATIENCE_S
    _copy: Copy | None = None
    _copying: threading.Lock = field(default_factory=threading.Lock)
    _turns: threading.Semaphore = field(default_factory=lambda: threading.Semaphore(AT_ONCE))
    _places: threading.Semaphore = field(
        default_factory=lambda: threading.Semaphore(AT_ONCE + WAITING)
    )

    def result(self, sql: str) -> QueryResult:
        """What a query finds, as much of it as is shown; raises NoAnswer and UsageError."""
        said, _ = self._answer(sql, as_csv=False)
        columns = [(name, kind) for name, kind in said["columns"]]
        return QueryResult(columns, said["rows"], said["more"], said["seconds"])

    def csv(self, sql: str) -> bytes:
        """All that a query finds; raises NoAnswer and UsageError."""
        return self._answer(sql, as_csv=True)[1]

    def close(self) -> None:
        """Delete the copy; if a query reads it, it lasts until that has ended."""
        self._copy = None

    def _answer(self, sql: str, *, as_csv: bool) -> Answer:
        if len(sql) > LONGEST:
            raise NoAnswer(f"a query has up to {LONGEST:,} characters here, this one {len(sql):,}")
        caps = self.caps
        if as_csv:
            caps = replace(caps, rows=DOWNLOADED_ROWS, size=DOWNLOADED_BYTES)
        with self._turn():
            copy = self._current()
            query = Query(f"/dev/fd/{copy.fd}", sql, as_csv, caps)
            try:
                with closing(_worker(copy.fd)) as worker:
                    return worker.ask(
                        asdict(query), seconds=caps.seconds, most_bytes=caps.size + SAID_BYTES
                    )
            except Ended as exc:
                raise NoAnswer(self._silence(exc)) from exc

    def _silence(self, ended: Ended) -> str:
        """Why a process may have ended without an answer."""
        if ended.late:
            return f"stopped after {self.caps.seconds:g} s"
        if ended.code < 0:  # a signal: of the system, or of a library in need
            return f"the query needed more than {self.caps.memory_mb} MB, or DuckDB failed at it"
        return f"the process of the query ended with code {ended.code}"

    @contextmanager
    def _turn(self) -> Iterator[None]:
        # Counted apart from the turns, so that whoever is one too many hears it at once.
        if not self._places.acquire(blocking=False):
            raise NoAnswer("too many queries are waiting: run it again in a moment")
        try:
            if not self._turns.acquire(timeout=self.patience_s):
                raise NoAnswer(
                    f"{AT_ONCE} other queries are running, and none ended within "
                    f"{self.patience_s:g} s: run it again in a moment"
                )
            try:
                yield
            finally:
                self._turns.release()
        finally:
            self._places.release()

    def _current(self) -> Copy:
        """A copy of the database as it is."""
        with self._copying:
            stamp = stamp_of(self.db)
            if self._copy is None or self._copy.stamp != stamp:
                self._copy = None  # the old one makes room first
                self._copy = Copy(self.db, stamp)
            return self._copy


def _worker(*files: int) -> Child:
    """A process for one job, which knows as little of us as it can; raises NoAnswer."""
    environment = {name: os.environ[name] for name in ("TZ", "TMPDIR") if name in os.environ}
    # An arena for each thread would take addresses that a query could use.
    environment |= {"PYTHONPATH": str(PROJECT), "MALLOC_ARENA_MAX": "1"}
    return Child("analysis.explorer.query_worker", environment=environment, files=files, quiet=True)
