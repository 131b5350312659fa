"""One reader of the database at a time within the explorer.

The system frees a process's locks on a file when any part of the process closes it: a sweep could
then write while another thread still reads.
"""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import duckdb

from merge_runner.database import SHARED, Instance, read_database

ALONE = threading.RLock()


@contextmanager
def reading(db: Path, instance: Instance = SHARED) -> Iterator[duckdb.DuckDBPyConnection]:
    """Open the database for reading, for a moment; raises UsageError and StoreError."""
    with ALONE, read_database(db, instance) as connection:
        yield connection
