"""A copy of the database, which pages and queries read: the database is open only while copied.

So a sweep can write meanwhile. A copy lasts as long as the file stays as it is.
"""

from __future__ import annotations

import os
import shutil
import tempfile
import threading
import weakref
from contextlib import suppress
from pathlib import Path

import duckdb

from merge_runner.errors import StoreLocked, UsageError
from merge_runner_analysis.cache import stamp_of
from merge_runner_analysis.web.reading import PATIENCE_S, reading

# The database comes after its logs: a process that closes a file loses all its locks on it.
FILES = (".wal", ".wal.checkpoint", ".wal.recovery", "")


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
