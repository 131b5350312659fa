"""Runs a user's query in a process that can be killed, on a copy of the database.

The database is open only while it is copied, so that a sweep can write while a query takes long.
A copy lasts as long as the file stays as it is.
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import tempfile
import threading
import weakref
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from analysis.explorer.catalogue import stamp_of
from analysis.explorer.query_worker import MEMORY, Copying, Query, job_text
from merge_runner.paths import PROJECT

AT_ONCE = 2
WAITING = 8  # beside those that run: each keeps a thread of the server
PATIENCE_S = 20.0
COPYING_S = 60.0
LONGEST = 10_000  # characters of a query
DOWNLOADED_ROWS = 100_000
DOWNLOADED_BYTES = 50_000_000
SAID_BYTES = 1_000_000  # of errors, and around a result


class NoAnswer(Exception):
    """Why a query has no result, in a line."""


@dataclass(frozen=True, slots=True)
class Caps:
    """What a query may take, and how much of its result is shown."""

    seconds: float = 10.0
    memory_mb: int = 512
    rows: int = 1_000
    text: int = 2_000
    """Characters of a cell."""
    size: int = 5_000_000
    """Bytes."""


@dataclass(frozen=True, slots=True)
class Result:
    """What a query found: names and types of columns, and texts; None is NULL.

    A text comes with how many of its characters are left out. With ``more`` there are more rows.
    """

    columns: list[tuple[str, str]]
    rows: list[list[tuple[str, int] | None]]
    more: bool
    seconds: float


class Copy:
    """A copy of a database, which has no name: it goes when nobody holds it any more.

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
            copying = Copying(str(db.resolve()), f"{folder}/results.duckdb")
            told = _asked(copying, COPYING_S, SAID_BYTES)
            if told is None:
                raise NoAnswer("the database could not be copied in a minute: is it being written?")
            if "error" in told[0]:
                raise NoAnswer(_without_folders(told[0]["error"], copying))
            self.fd = os.open(copying.copy, os.O_RDONLY)
        finally:
            shutil.rmtree(folder, ignore_errors=True)
        weakref.finalize(self, os.close, self.fd)


@dataclass
class Sandbox:
    """Queries of one database."""

    db: Path
    caps: Caps = Caps()
    patience_s: float = PATIENCE_S
    _copy: Copy | None = None
    _copying: threading.Lock = field(default_factory=threading.Lock)
    _turns: threading.Semaphore = field(default_factory=lambda: threading.Semaphore(AT_ONCE))
    _places: threading.Semaphore = field(
        default_factory=lambda: threading.Semaphore(AT_ONCE + WAITING)
    )

    def result(self, sql: str) -> Result:
        """What a query finds, as much of it as is shown; raises NoAnswer and UsageError."""
        said, _ = self._answer(sql, as_csv=False)
        columns = [(name, kind) for name, kind in said["columns"]]
        return Result(columns, said["rows"], said["more"], said["seconds"])

    def csv(self, sql: str) -> bytes:
        """All that a query finds; raises NoAnswer and UsageError."""
        return self._answer(sql, as_csv=True)[1]

    def close(self) -> None:
        """Delete the copy, unless a query reads it: that one will."""
        self._copy = None

    def _answer(self, sql: str, *, as_csv: bool) -> tuple[dict[str, Any], bytes]:
        if len(sql) > LONGEST:
            raise NoAnswer(f"a query has up to {LONGEST:,} characters here, this one {len(sql):,}")
        caps = self.caps
        size = DOWNLOADED_BYTES if as_csv else caps.size
        with self._turn():
            copy = self._current()
            query = Query(
                file=f"/dev/fd/{copy.fd}",
                sql=sql,
                as_csv=as_csv,
                rows=DOWNLOADED_ROWS if as_csv else caps.rows,
                text=caps.text,
                size=size,
                memory_mb=caps.memory_mb,
                seconds=caps.seconds,
            )
            told = _asked(query, caps.seconds, size + SAID_BYTES, copy.fd)
        if told is None:
            raise NoAnswer(f"stopped after {caps.seconds:g} s")
        error = told[0].get("error")
        if error == MEMORY:
            raise NoAnswer(f"the query needed more than {caps.memory_mb} MB")
        if error is not None:
            raise NoAnswer(error)
        return told

    @contextmanager
    def _turn(self) -> Iterator[None]:
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


def _asked(
    job: Query | Copying, seconds: float, size: int, *files: int
) -> tuple[dict[str, Any], bytes] | None:
    """What a process says, up to so many bytes; None where it was killed for taking too long.

    It is given the open ``files``. Raises NoAnswer where it ended without a word.
    """
    process = subprocess.Popen(
        [sys.executable, "-s", "-X", "utf8", "-m", "analysis.explorer.query_worker"],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        cwd=PROJECT,
        env=_environment(),
        pass_fds=files,
    )
    assert process.stdin is not None
    assert process.stdout is not None
    late = threading.Event()

    def stop() -> None:
        late.set()
        process.kill()

    clock = threading.Timer(seconds, stop)
    clock.start()
    try:
        try:
            process.stdin.write(job_text(job).encode())
            process.stdin.close()
        except BrokenPipeError:
            pass  # it died: its silence says so
        said = process.stdout.read(size + 1)
    finally:
        clock.cancel()
        process.kill()
        code = process.wait()
        process.stdout.close()
    if len(said) > size:
        raise NoAnswer("the result is too large to be shown: select less of it")
    head, found, body = said.partition(b"\n")
    if found:
        told: dict[str, Any] = json.loads(head)
        return told, body
    if late.is_set():
        return None
    raise NoAnswer(_silence(job, code))


def _without_folders(text: str, job: Copying) -> str:
    """What went wrong with a copy, for those whom the machine is no business of."""
    for path in (job.database, job.copy):
        text = text.replace(f"{Path(path).parent}{os.sep}", "")
    return text


def _silence(job: Query | Copying, code: int) -> str:
    """Why a process may have ended without a word."""
    if isinstance(job, Query) and code < 0:  # a signal: of the system, or of a library in need
        return f"the query needed more than {job.memory_mb} MB, or DuckDB failed at it"
    return f"the process of the query ended with code {code}"


def _environment() -> dict[str, str]:
    """Nothing of ours, among which there are keys, but the time zone.

    An arena for each thread would take addresses that a query could use.
    """
    kept = {name: os.environ[name] for name in ("TZ", "TMPDIR") if name in os.environ}
    return {**kept, "MALLOC_ARENA_MAX": "1"}
