"""Opens the results database and waits for other programs that hold it."""

from __future__ import annotations

import asyncio
import atexit
import contextlib
import logging
import os
import re
import shutil
import tempfile
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
from merge_runner.scenarios.merge.measures import measures_sql, measures_version
from merge_runner.text_safety import first_line, quoted

SCHEMA_VERSION = 10
SCHEMA = Path(__file__).with_name("schema.sql")
"""The tables; see ``schema_sql`` for all that a database has."""
LOCK_RETRY_S = 0.05
PATIENCE_S = 60.0
ROWS_AT_ONCE = 100
ROWS_OF_A_GROUP = 4_096
"""Of what is written: a group is rewritten, in memory, with each transaction until it is full."""
BYTES_OF_A_CALL, MERGED_BYTES = 3_000, 2**26
"""How many a call takes where replies are short, compressed and with its share of the states, and
by how much the file may exceed that for its row groups still to be merged."""
SIZES = """
SELECT greatest(max(stats(request).max_string_length), max(stats(reply).max_string_length), 0),
    (SELECT count(*) FROM calls)
FROM (SELECT request, reply FROM calls LIMIT 1)
"""
LOG = logging.getLogger(__name__)
ResultT = TypeVar("ResultT")
Settings = dict[str, str | bool | int | float | list[str]]
SETTINGS: Settings = {
    # The defaults are shares of the machine's, and most of that memory would cache the file. A
    # thread unpacks the texts of 2,048 rows at once: 128 MB where replies are of 64 KB.
    "memory_limit": "1GB",  # see limit_memory
    "threads": 2,
    "max_vacuum_tasks": 0,  # see merge_small_groups
    # Of new files: the oldest DuckDB that can open them.
    "storage_compatibility_version": "v1.2.0",
}
REBUILD = (
    "move it away, or name another with --db, and run the same sweep again: it is rebuilt from the "
    "cache without a call"
)


def schema_sql() -> str:
    """The SQL that makes a database: its tables, and views of them with the measures."""
    return f"{SCHEMA.read_text(encoding='utf-8')}\n{measures_sql()}"


def has_these_measures(connection: duckdb.DuckDBPyConnection) -> bool:
    """Whether this version of the program defined the measures of the open database."""
    return connection.execute("SELECT measures_version()").fetchone() == (measures_version(),)


@cache  # warns once per file, which a page may read a hundred times
def warn_of_other_measures(path: Path) -> None:
    """Log that another version of the program defined the measures of a database."""
    LOG.warning(
        "another version of the program defined the measures (trial_metrics and its views) of %s, "
        "and they are read as they are; `merge-runner sweep` into it brings them up to date",
        path,
    )


@cache
def _spill_folder(pid: int) -> str:
    """Make the private folder of a process for what does not fit into memory; it goes with it.

    A name that others can tell beforehand could be a folder of theirs.
    """
    folder = tempfile.mkdtemp(prefix="merge-runner-")

    def remove() -> None:
        if os.getpid() == pid:  # and not a fork of it
            shutil.rmtree(folder, ignore_errors=True)

    atexit.register(remove)
    return folder


def in_memory(settings: Settings) -> duckdb.DuckDBPyConnection:
    """A new database in memory, which spills into a private folder."""
    spilling: Settings = {"temp_directory": _spill_folder(os.getpid())}
    connection = duckdb.connect(config=settings | spilling)
    # DuckDB takes `python -c` for an interactive prompt: a slow query would draw into our output.
    # In a notebook without ipywidgets it can draw nothing, and refuses to be told so.
    with contextlib.suppress(duckdb.InvalidInputException):
        connection.execute("SET enable_progress_bar = false")
    return connection


class Instance:
    """A DuckDB instance; attaching a file to it takes the file's lock, detaching frees it.

    Making an instance takes longer than most queries, so one is used for everything. After an error
    it may be unusable, and a new one is made.
    """

    def __init__(self) -> None:
        self._connection: duckdb.DuckDBPyConnection | None = None

    def cursor(self) -> duckdb.DuckDBPyConnection:
        """A separate connection to the instance."""
        if self._connection is None:
            self._connection = in_memory(SETTINGS)
        return self._connection.cursor()

    def drop(self) -> None:
        """Make a new instance next time; this one ends with the last of its connections.

        Closing it would close those of other threads with it.
        """
        self._connection = None


class Reading:
    """What a thread does with databases, which another thread may end."""

    def __init__(self) -> None:
        self.is_over = False
        self._connection: duckdb.DuckDBPyConnection | None = None
        self._one_at_a_time = Lock()  # a connection that is interrupted is not closed meanwhile

    def uses(self, connection: duckdb.DuckDBPyConnection | None) -> None:
        """Note the connection that is open; None before it is closed."""
        with self._one_at_a_time:
            self._connection = connection

    def end(self) -> None:
        """End the query that runs, and what waits for a file; one that begins later goes on."""
        with self._one_at_a_time:
            self.is_over = True
            if self._connection is not None:
                self._connection.interrupt()


_READING: ContextVar[Reading | None] = ContextVar("reading", default=None)


async def in_thread(read: Callable[[], ResultT]) -> ResultT:
    """Read databases in a thread; a task that is cancelled ends the reading before it ends."""
    reading = Reading()

    def reads() -> ResultT:
        _READING.set(reading)  # in the thread's own context
        return read()

    # No task: Ctrl-C may cancel all tasks of the loop, and the thread would go on unseen.
    loop = asyncio.get_running_loop()
    thread = loop.run_in_executor(None, copy_context().run, reads)
    try:
        await asyncio.wait([thread])
    except (asyncio.CancelledError, KeyboardInterrupt):  # Ctrl-C may come before it waits
        while not thread.done():
            reading.end()  # again, where it was between two queries
            with contextlib.suppress(asyncio.CancelledError):
                await asyncio.wait([thread], timeout=LOCK_RETRY_S)
        thread.exception()  # nobody wants it any more
        raise
    return thread.result()


SHARED = Instance()
OURS = "merge_runner_"  # begins the names under which files are attached here
# Another process holds the file; another connection of this one does.
_BUSY = ("Could not set lock", "Unique file handle conflict", "already attached")


@contextmanager
def open_database(
    path: Path, *, read_only: bool, patience_s: float, instance: Instance = SHARED
) -> Iterator[duckdb.DuckDBPyConnection]:
    """Open the database, waiting until others close it; raises StoreError."""
    connection, reading = instance.cursor(), _READING.get()
    name = f"{OURS}{id(connection)}"  # of no other file that is open
    mode = "READ_ONLY" if read_only else f"READ_WRITE, ROW_GROUP_SIZE {ROWS_OF_A_GROUP}"
    # A name such as md:x or :memory: names a file, too.
    _attach(connection, f"{quoted(path.absolute())} AS {name} ({mode})", path, patience_s, instance)
    try:
        if reading is not None:
            reading.uses(connection)
        # Whoever used the instance before may have limited it; see limit_memory.
        connection.execute(
            f"USE {name}; SET memory_limit = '{SETTINGS['memory_limit']}'; "
            f"SET threads = {SETTINGS['threads']}"
        )
        yield connection
    except BaseException:
        instance.drop()
        raise
    else:
        try:
            connection.execute(f"USE memory; DETACH {name}")
        except duckdb.Error as exc:
            # As on a full disk: what was committed stays in the log beside the file.
            LOG.warning("the database was not closed in order: %s", first_line(exc))
            instance.drop()
    finally:
        if reading is not None:
            reading.uses(None)
        connection.close()


def _attach(
    connection: duckdb.DuckDBPyConnection,
    file: str,
    path: Path,
    patience_s: float,
    instance: Instance,
) -> None:
    """Attach a file, again and again while another one holds it."""
    began, told, reading = time.monotonic(), False, _READING.get()
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
            if waited_s > 1 and not told:
                told = True
                LOG.warning(
                    "waiting up to %.0f s for %s to close %s", patience_s, _holder(exc), path
                )
            time.sleep(LOCK_RETRY_S)
        else:
            return


def _is_of_this_process(exc: duckdb.Error) -> bool:
    """Whether a connection of the user, as in a notebook, holds the file; ours soon close it."""
    return bool(re.search(rf'already attached by database "(?!{OURS}\d+")', str(exc)))


def _holder(exc: duckdb.Error) -> str:
    """Who holds the file, as DuckDB says it: the program and its process."""
    found = re.search(r"lock is held in (.+) \(PID (\d+)\)", str(exc))
    return f"{Path(found[1]).name} (PID {found[2]})" if found else "another program"


def limit_memory(connection: duckdb.DuckDBPyConnection, longest: int = 0) -> None:
    """Let DuckDB use little memory, and one thread, where texts are short and calls not many.

    That holds until the instance opens a database again. ``longest`` is the length of the longest
    text that will be stored. A row group of such calls takes 64 MB, an audit of 200,000 of them
    110 MB; more would only cache the file.
    """
    [(stored, calls)] = connection.execute(SIZES).fetchall()
    is_little = bool(max(stored, longest) < 8_192 and calls < 210_000)
    limit = f"{110 + calls // 7_000}MB" if is_little else SETTINGS["memory_limit"]
    connection.execute(f"SET memory_limit = '{limit}'; SET threads = {2 - is_little}")


def merge_small_groups(connection: duckdb.DuckDBPyConnection) -> None:
    """Let the next write merge small row groups, unless the rows hold long texts.

    Merging takes as much memory as the texts of a full group, and rewrites these each time.
    """
    [(calls, path)] = connection.execute(
        "SELECT estimated_size, path FROM duckdb_tables() JOIN duckdb_databases() "
        "USING (database_name) WHERE table_name = 'calls' AND database_name = current_database()"
    ).fetchall()
    most_bytes = calls * BYTES_OF_A_CALL + MERGED_BYTES
    connection.execute(f"SET max_vacuum_tasks = {100 * (Path(path).stat().st_size <= most_bytes)}")


def of_sweeps(sweep_ids: Iterable[str]) -> str:
    """What is true, in SQL, of the rows of some sweeps."""
    return f"sweep_id IN ({', '.join(map(quoted, sweep_ids))})"


def only(sweep_ids: Iterable[str] | None) -> str:
    """What keeps, in SQL, the rows of the trials of some sweeps; None: all are kept."""
    if sweep_ids is None:
        return ""
    wanted = f"FROM sweep_trials WHERE {of_sweeps(sweep_ids)}"
    return f"SEMI JOIN ({wanted}) USING (trial_id, spec_hash)"


def fetched(result: duckdb.DuckDBPyConnection) -> Iterator[tuple[Any, ...]]:
    """The rows of a result, a few at a time; its connection runs no other query until the end."""
    return chain.from_iterable(iter(partial(result.fetchmany, ROWS_AT_ONCE), []))


def names_of(result: duckdb.DuckDBPyConnection) -> list[str]:
    """The names of a result's columns."""
    return [column[0] for column in result.description or ()]


def by_name(result: duckdb.DuckDBPyConnection) -> Iterator[dict[str, Any]]:
    """The rows of a result, each by the names of its columns."""
    names = names_of(result)
    return (dict(zip(names, row, strict=True)) for row in result.fetchall())


def append(
    connection: duckdb.DuckDBPyConnection, table: str, rows: Iterable[tuple[Any, ...]]
) -> None:
    """Add rows to a table."""
    appender = connection.appender(table)  # an INSERT would be a statement for each row
    appender.append_rows(list(rows))
    appender.flush()


@contextmanager
def write_database(
    path: Path, patience_s: float = PATIENCE_S
) -> Iterator[duckdb.DuckDBPyConnection]:
    """Open the database for one transaction, which is committed at the end; raises StoreError."""
    with open_database(path, read_only=False, patience_s=patience_s) as connection:
        try:
            connection.begin()
            yield connection
            connection.commit()
        except duckdb.Error as exc:
            raise StoreError(f"{path} cannot be used: {first_line(exc)}") from exc


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
    """A damaged file, or one that is not a database, is for the user to replace."""
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
