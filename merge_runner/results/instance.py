"""DuckDB instances and their memory."""

from __future__ import annotations

import atexit
import contextlib
import os
import shutil
import tempfile
from functools import cache
from pathlib import Path

import duckdb

BYTES_OF_A_CALL, MERGED_BYTES = 1_000, 2**26
"""Compressed bytes of a call with short replies and its share of the states; and the excess of the
file's size up to which its row groups are merged."""
MANY_CALLS = 256
"""Calls that are added at once and need not be merged: their blocks are nearly full."""
SIZES = """
SELECT greatest(max(stats(request).max_string_length::BIGINT),
    max(stats(reply).max_string_length::BIGINT), 0), (SELECT count(*) FROM calls)
FROM (SELECT request, reply FROM calls WHERE rowid < 0 UNION ALL SELECT NULL, NULL)
"""
"""Length of the longest text, from DuckDB's statistics alone, and the number of calls."""
Settings = dict[str, str | bool | int | float | list[str]]
SETTINGS: Settings = {
    # DuckDB's defaults are shares of the machine's memory, mostly spent on caching the file. A
    # thread unpacks the texts of 2,048 rows at once: 128 MB for replies of 64 KB.
    "memory_limit": "1GB",  # limit_memory lowers it
    "threads": 2,
    "max_vacuum_tasks": 0,  # merge_small_groups raises it
    # A commit writes into the file alone; else it writes a log, which detaching copies into it.
    "checkpoint_threshold": "0B",
    "default_block_size": "16384",  # the least: every write begins new blocks for each column
    "force_compression": "zstd",  # a quarter of the size of what DuckDB chooses, and written sooner
    # The oldest DuckDB that can open new files.
    "storage_compatibility_version": "v1.2.0",
}


@cache
def _spill_folder(pid: int) -> str:
    """Create the private spill folder of a process, removed at its exit.

    Another user could own a folder with a predictable name.
    """
    folder = tempfile.mkdtemp(prefix="merge-runner-")

    def remove() -> None:
        if os.getpid() == pid:  # not in a fork
            shutil.rmtree(folder, ignore_errors=True)

    atexit.register(remove)
    return folder


def in_memory(settings: Settings) -> duckdb.DuckDBPyConnection:
    """Return a new in-memory database that spills into a private folder."""
    spilling: Settings = {"temp_directory": _spill_folder(os.getpid())}
    connection = duckdb.connect(config=settings | spilling)
    # DuckDB takes `python -c` for an interactive prompt and would draw a progress bar for a slow
    # query. In a notebook without ipywidgets it refuses this setting.
    with contextlib.suppress(duckdb.InvalidInputException):
        connection.execute("SET enable_progress_bar = false")
    return connection


class Instance:
    """DuckDB instance; attaching a file takes the file's lock, detaching releases it.

    Creating an instance takes longer than most queries, so that one is shared. After an error it
    may be unusable and is replaced.
    """

    def __init__(self, settings: Settings = SETTINGS) -> None:
        self._settings = settings
        self._connection: duckdb.DuckDBPyConnection | None = None

    def cursor(self) -> duckdb.DuckDBPyConnection:
        """Return a separate connection to the instance."""
        if self._connection is None:
            self._connection = in_memory(self._settings)
        return self._connection.cursor()

    def drop(self) -> None:
        """Create a new instance at the next use; this one ends with its last connection.

        Closing it would close the connections of other threads.
        """
        self._connection = None


def limit_memory(connection: duckdb.DuckDBPyConnection, longest: int = 0) -> int:
    """Limit DuckDB to little memory and one thread for short texts and few calls.

    Returns the length of the longest stored text.

    The limit holds until the instance closes the database. ``longest`` is the length of the
    longest text to store. A row group of such calls takes 32 MB, an audit of 200,000 calls 110 MB;
    more memory would only cache the file.
    """
    [(stored, calls)] = connection.execute(SIZES).fetchall()
    is_little = bool(max(stored, longest) < 8_192 and calls < 210_000)
    limit = f"{110 + calls // 7_000}MB" if is_little else SETTINGS["memory_limit"]
    connection.execute(f"SET memory_limit = '{limit}'; SET threads = {2 - is_little}")
    return int(stored)


def merge_small_groups(connection: duckdb.DuckDBPyConnection, added: int) -> None:
    """Let the next write merge a few small row groups, unless it adds many calls or long texts.

    Merging takes as much memory as the texts of a full group, and rewrites the group each time: the
    file is held twice as long. All groups at once would double the file.
    """
    merges = False
    if added < MANY_CALLS:
        [(calls, path)] = connection.execute(
            "SELECT (SELECT count(*) FROM calls), path FROM duckdb_databases() "
            "WHERE database_name = current_database()"
        ).fetchall()
        merges = Path(path).stat().st_size <= calls * BYTES_OF_A_CALL + MERGED_BYTES
    connection.execute(f"SET max_vacuum_tasks = {merges:d}")
