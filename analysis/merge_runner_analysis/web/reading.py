"""One reader of the database at a time within the explorer, which copies it.

The system frees a process's locks on a file when any part of the process closes it: a sweep could
then write while another thread still reads. Pages and queries read a copy, so that a sweep can
write meanwhile. The copy is replaced when the file changes.
"""

from __future__ import annotations

import os
import shutil
import tempfile
import threading
import weakref
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import duckdb

from merge_runner.errors import StoreLocked, UsageError
from merge_runner.results.database import by_name, read_database
from merge_runner.text_safety import first_line
from merge_runner_analysis.cache import stamp_of

ALONE = threading.RLock()
# A sweep that stores its trials holds the file for less; a page cannot wait for anybody else.
PATIENCE_S = 2.0
# The database comes after its logs: a process that closes a file loses all its locks on it.
FILES = (".wal", ".wal.checkpoint", ".wal.recovery", "")

Row = dict[str, Any]


@contextmanager
def readable(db: Path) -> Iterator[None]:
    """Raise UsageError where DuckDB cannot read the database.

    It may be damaged, made by another program, or replaced meanwhile.
    """
    try:
        yield
    except duckdb.Error as exc:
        raise UsageError(f"{db} cannot be read: {first_line(exc)}") from exc


@contextmanager
def reading(db: Path, patience_s: float = PATIENCE_S) -> Iterator[duckdb.DuckDBPyConnection]:
    """Open the database for reading, for a moment; raises UsageError and StoreError."""
    with readable(db), ALONE, read_database(db, patience_s=patience_s) as connection:
        yield connection


def records(
    connection: duckdb.DuckDBPyConnection, sql: str, values: Mapping[str, object] | Sequence[object]
) -> list[Row]:
    """Return the rows of a query, by the names of their columns."""
    return list(by_name(connection.execute(sql, values)))


class Copy:
    """A copy of a database as an open file without a name: it is gone when nobody holds it.

    So nothing is left of it when the program is killed, and no query can say where it lies.
    ``file`` is its name in SQL.
    """

    def __init__(self, db: Path, stamp: tuple[int, ...], patience_s: float) -> None:
        """Make it; raises UsageError and StoreLocked."""
        self.stamp = stamp
        try:
            with tempfile.TemporaryDirectory(prefix="merge-runner-view-") as folder:
                copy = f"{folder}/results.duckdb"
                with reading(db, patience_s):  # so that nobody writes
                    for end in FILES:
                        with suppress(FileNotFoundError):
                            shutil.copyfile(f"{db}{end}", f"{copy}{end}")
                if len(os.listdir(folder)) > 1:
                    with duckdb.connect(copy) as whole:  # it loses its name, and its log with it
                        whole.execute("CHECKPOINT")
                self.fd = os.open(copy, os.O_RDONLY)
        except OSError as exc:
            raise UsageError(f"the database cannot be copied: {exc.strerror}") from exc
        weakref.finalize(self, os.close, self.fd)
        self.file = f"'/dev/fd/{self.fd}'"


class Copies:
    """The present copy of a database.

    ``is_locked``: another program holds the database, and the copy is an earlier one.
    """

    def __init__(self, db: Path) -> None:
        self.db = db
        self.is_locked = False
        self._copy: Copy | None = None
        self._copying = threading.Lock()

    def current(self) -> Copy:
        """Return a copy of the database as it is, or was before another program held it.

        Raises UsageError and StoreLocked.
        """
        with self._copying:
            stamp, before = stamp_of(self.db), self._copy
            if before is not None and before.stamp == stamp:
                self.is_locked = False
                return before
            if before is not None and before.stamp[:1] != stamp[:1]:
                before = None  # another file has taken the name
            self._copy = None  # nor is it shown instead of what cannot be read
            try:
                # A reader that found it held once does not wait again.
                self._copy = Copy(self.db, stamp, 0.0 if self.is_locked else PATIENCE_S)
            except StoreLocked:
                if before is None:
                    raise
                self._copy = before
            self.is_locked = self._copy is before
            return self._copy
