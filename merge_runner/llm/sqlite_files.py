"""SQLite files that several processes and threads use."""

from __future__ import annotations

import contextlib
import fcntl
import os
import sqlite3
from collections.abc import Iterator
from pathlib import Path
from threading import Lock
from typing import Any

BUSY_S = 600.0  # another process may be writing long replies to a slow disk


@contextlib.contextmanager
def making(folder: Path) -> Iterator[None]:
    """Keep other processes from making a file in a folder; its name is durable afterwards."""
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX)
        yield
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


class Connection(sqlite3.Connection):
    """A connection for all threads; ``rows`` runs one query at a time.

    Threads share prepared statements, and one could read the row that another has asked for.
    """

    def __init__(self, uri: str) -> None:
        super().__init__(
            uri, uri=True, timeout=BUSY_S, isolation_level=None, check_same_thread=False
        )
        self._one_at_a_time = Lock()

    def rows(self, sql: str, *values: object) -> list[tuple[Any, ...]]:
        """Return the rows of a query."""
        with self._one_at_a_time:
            return self.execute(sql, values).fetchall()


def connect(file: Path, mode: str = "ro") -> Connection:
    """Return a connection of our own to an SQLite file; ``mode`` is SQLite's."""
    return Connection(f"{file.absolute().as_uri()}?mode={mode}")
