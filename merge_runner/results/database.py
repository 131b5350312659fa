"""Access to the results database, with waiting for other programs that hold it."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import os
import re
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar, copy_context
from functools import cache, partial
from itertools import chain
from pathlib import Path
from threading import Lock
from typing import Any, TypeVar

import duckdb

from merge_runner.errors import StoreError, StoreLocked, UsageError
from merge_runner.results.instance import SETTINGS, Instance
from merge_runner.scenarios.merge.measures import measures_sql, measures_version
from merge_runner.text_safety import first_line, quoted

SCHEMA_VERSION = 10
SCHEMA = Path(__file__).with_name("schema.sql")
"""Tables and views, without the views of measures (``schema_sql`` has both)."""
LOCK_RETRY_S = 0.005  # a sweep leaves the file for a moment between two writes
PATIENCE_S = 60.0
ROWS_AT_ONCE = 100
ROWS_OF_A_GROUP = 2_048
"""Size of written row groups: each transaction rewrites a group in memory until it is full."""
LOG = logging.getLogger(__name__)
ResultT = TypeVar("ResultT")
REBUILD = (
    "move it away, or name another with --db, and run the same sweep again: it is rebuilt from the "
    "cache without a call"
)


def schema_sql() -> str:
    """Return the SQL that creates a database: tables, views and measures."""
    return f"{SCHEMA.read_text(encoding='utf-8')}\n{measures_sql()}"


def has_these_measures(connection: duckdb.DuckDBPyConnection) -> bool:
    """Return whether the open database has the measures of this version of the program."""
    return connection.execute("SELECT measures_version()").fetchone() == (measures_version(),)


@cache  # one warning per file, which a page may read a hundred times
def warn_of_other_measures(path: Path) -> None:
    """Warn that a database has the measures of another version of the program."""
    LOG.warning(
        "another version of the program defined the measures (trial_metrics and its views) of %s, "
        "and they are read as they are; `merge-runner sweep` into it brings them up to date",
        path,
    )


class Reading:
    """Database reads of one thread, which another thread may interrupt."""

    def __init__(self) -> None:
        self.is_over = False
        self._connection: duckdb.DuckDBPyConnection | None = None
        self._one_at_a_time = Lock()  # a connection that is interrupted is not closed meanwhile

    def uses(self, connection: duckdb.DuckDBPyConnection | None) -> None:
        """Set the open connection; None before it is closed."""
        with self._one_at_a_time:
            self._connection = connection

    def end(self) -> None:
        """Interrupt the running query and the wait for a file; a later query is not interrupted."""
        with self._one_at_a_time:
            self.is_over = True
            if self._connection is not None:
                self._connection.interrupt()


_READING: ContextVar[Reading | None] = ContextVar("reading", default=None)


async def in_thread(read: Callable[[], ResultT]) -> ResultT:
    """Read databases in a thread; cancelling the task interrupts the thread and waits for it."""
    reading = Reading()

    def reads() -> ResultT:
        _READING.set(reading)  # in the thread's own context
        return read()

    # Not a task: Ctrl-C may cancel all tasks of the loop, and the thread would run on unnoticed.
    loop = asyncio.get_running_loop()
    thread = loop.run_in_executor(None, copy_context().run, reads)
    try:
        await asyncio.wait([thread])
    except (asyncio.CancelledError, KeyboardInterrupt):  # Ctrl-C may come before the wait
        while not thread.done():
            reading.end()  # repeated, since the thread may have been between two queries
            with contextlib.suppress(asyncio.CancelledError):
                await asyncio.wait([thread], timeout=LOCK_RETRY_S)
        thread.exception()  # retrieved, or asyncio would log it
        raise
    return thread.result()


SHARED = Instance()
RESET = "; ".join(
    f"SET {name} = '{SETTINGS[name]}'" for name in ("memory_limit", "threads", "max_vacuum_tasks")
)
ATTACHED = "merge_runner_"  # prefix of the names of attached files
# The file is held by another process, or by another connection of this one.
_BUSY = ("Could not set lock", "Unique file handle conflict", "already attached")


@contextmanager
def open_database(
    path: Path,
    *,
    read_only: bool,
    patience_s: float,
    instance: Instance = SHARED,
    cursor: duckdb.DuckDBPyConnection | None = None,
) -> Iterator[duckdb.DuckDBPyConnection]:
    """Open the database once other programs have closed it; raises StoreError.

    A ``cursor`` of the instance stays open; without one, there is a new one.
    """
    connection, reading = cursor or instance.cursor(), _READING.get()
    name = f"{ATTACHED}{id(connection)}"  # unique among the open files
    mode = "READ_ONLY" if read_only else f"READ_WRITE, ROW_GROUP_SIZE {ROWS_OF_A_GROUP}"
    # As an absolute path, since DuckDB gives names such as md:x or :memory: another meaning.
    _attach(connection, f"{quoted(path.absolute())} AS {name} ({mode})", path, patience_s, instance)
    is_detached = False
    try:
        if reading is not None:
            reading.uses(connection)
        connection.execute(f"USE {name}")
        yield connection
        is_detached = _detach(connection, name)
        if instance is SHARED:  # other instances may not be configured any more
            # The user may have called limit_memory and merge_small_groups. The file is not held
            # meanwhile: DuckDB returns memory to the system, which takes up to 7 ms.
            connection.execute(RESET)
    finally:
        if not is_detached:  # as after any error of the block
            instance.drop()
        if reading is not None:
            reading.uses(None)
        if cursor is None:
            connection.close()


def _detach(connection: duckdb.DuckDBPyConnection, name: str) -> bool:
    """Return whether a file was detached; as on a full disk, its write-ahead log may remain."""
    try:
        connection.execute(f"USE memory; DETACH {name}")
    except duckdb.Error as exc:
        LOG.warning("the database was not closed in order: %s", first_line(exc))
        return False
    return True


def _attach(
    connection: duckdb.DuckDBPyConnection,
    file: str,
    path: Path,
    patience_s: float,
    instance: Instance,
) -> None:
    """Attach a file, with retries while another program holds it."""
    began, has_warned, reading = time.monotonic(), False, _READING.get()
    while True:
        try:
            connection.execute(f"ATTACH {file}")
        except duckdb.Error as exc:
            busy, waited_s = any(words in str(exc) for words in _BUSY), time.monotonic() - began
            if not busy:
                instance.drop()
                raise StoreError(
                    f"{path} cannot be opened as a database: {first_line(exc)}"
                ) from exc
            if _is_of_this_process(exc):
                raise StoreLocked(
                    f"{path} is open in this process (PID {os.getpid()}) too, as by "
                    "duckdb.connect: close that connection"
                ) from exc
            if waited_s >= patience_s or (reading is not None and reading.is_over):
                raise StoreLocked(f"{path} is held by {_holder(exc)}: close it there") from exc
            if waited_s > 1 and not has_warned:
                has_warned = True
                LOG.warning(
                    "waiting up to %.0f s for %s to close %s", patience_s, _holder(exc), path
                )
            time.sleep(LOCK_RETRY_S)
        else:
            return


def _is_of_this_process(exc: duckdb.Error) -> bool:
    """Return whether the user's own connection holds the file, as in a notebook."""
    # Connections of the program close soon.
    return bool(re.search(rf'already attached by database "(?!{ATTACHED}\d+")', str(exc)))


def _holder(exc: duckdb.Error) -> str:
    """Return the program and process id that hold the file, from DuckDB's message."""
    match = re.search(r"lock is held in (.+) \(PID (\d+)\)", str(exc))
    return f"{Path(match[1]).name} (PID {match[2]})" if match else "another program"


def of_sweeps(sweep_ids: Iterable[str]) -> str:
    """Return the SQL condition for rows of these sweeps."""
    return f"sweep_id IN ({', '.join(map(quoted, sweep_ids))})"


def only(sweep_ids: Iterable[str] | None) -> str:
    """Return the SQL join that keeps the trials of these sweeps; None: an empty text."""
    if sweep_ids is None:
        return ""
    trials = f"FROM sweep_trials WHERE {of_sweeps(sweep_ids)}"
    return f"SEMI JOIN ({trials}) USING (trial_id, spec_hash)"


def fetched(result: duckdb.DuckDBPyConnection) -> Iterator[tuple[Any, ...]]:
    """Return the rows of a result, fetched in chunks; the connection is busy until the last."""
    return chain.from_iterable(iter(partial(result.fetchmany, ROWS_AT_ONCE), []))


def names_of(result: duckdb.DuckDBPyConnection) -> list[str]:
    """Return the column names of a result."""
    return [column[0] for column in result.description or ()]


def by_name(result: duckdb.DuckDBPyConnection) -> Iterator[dict[str, Any]]:
    """Return the rows of a result as dictionaries by column."""
    names = names_of(result)
    return (dict(zip(names, row, strict=True)) for row in result.fetchall())


@contextmanager
def write_database(
    path: Path, patience_s: float = PATIENCE_S, cursor: duckdb.DuckDBPyConnection | None = None
) -> Iterator[duckdb.DuckDBPyConnection]:
    """Open the database for one transaction, committed at the end; raises StoreError."""
    with (
        open_database(path, read_only=False, patience_s=patience_s, cursor=cursor) as connection,
        errors_of(path),
    ):
        connection.begin()
        yield connection
        connection.commit()


@contextmanager
def errors_of(path: Path) -> Iterator[None]:
    """Turn DuckDB's errors into a StoreError that names the database."""
    try:
        yield
    except duckdb.Error as exc:
        # DuckDB's own words on a commit, which is a checkpoint too, go before what went wrong.
        why = first_line(exc).rpartition("Original error: ")[2]
        raise StoreError(f"{path} cannot be used: {why}") from exc


@contextmanager
def read_database(
    path: Path, instance: Instance = SHARED, patience_s: float = PATIENCE_S
) -> Iterator[duckdb.DuckDBPyConnection]:
    """Open an existing database for reading; raises UsageError."""
    if not path.is_file():
        raise UsageError(
            f"there is no database {path}; `merge-runner sweep baseline` makes one, --db names "
            "another"
        )
    with (
        unreadable_is_usage(),
        open_database(path, read_only=True, patience_s=patience_s, instance=instance) as connection,
    ):
        check_schema(connection, path)
        if not has_these_measures(connection):
            warn_of_other_measures(path)
        yield connection


@contextmanager
def unreadable_is_usage() -> Iterator[None]:
    """Turn errors of a damaged or foreign file into a UsageError with advice."""
    try:
        yield
    except StoreLocked:
        raise
    except StoreError as exc:
        if "No space left" in str(exc):
            raise StoreError(f"{exc}; make room, and run the same command again") from exc
        raise UsageError(f"{exc}; {REBUILD}") from exc
    except (duckdb.IOException, duckdb.CatalogException, duckdb.BinderException) as exc:
        raise UsageError(f"the database cannot be read: {first_line(exc)}; {REBUILD}") from exc


def check_schema(connection: duckdb.DuckDBPyConnection, path: Path) -> None:
    """Raise UsageError unless the open database has the schema of this program."""
    try:
        (version,) = connection.execute("SELECT schema_version FROM meta").fetchone() or (None,)
    except (duckdb.CatalogException, duckdb.BinderException) as exc:
        raise UsageError(
            f"{path} is not a database of merge-runner: name another with --db"
        ) from exc
    if version != SCHEMA_VERSION:
        raise UsageError(
            f"{path} has schema version {version}, and this merge-runner reads version "
            f"{SCHEMA_VERSION}: rebuild its results in a new file from recorded replies, without "
            "a call: `merge-runner sweep NAME --replay --recording FILE --db new.duckdb` (without "
            "--recording from the cache)"
        )
