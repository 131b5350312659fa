"""One reader of the database at a time within the explorer.

The system frees a process's locks on a file when any part of the process closes it: a sweep could
then write while another thread still reads.
"""

from __future__ import annotations

import threading
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import duckdb

from merge_runner.errors import UsageError
from merge_runner.results.database import by_name, read_database
from merge_runner.text_safety import first_line

ALONE = threading.RLock()
# A sweep that stores its trials holds the file for less; a page cannot wait for anybody else.
PATIENCE_S = 2.0

Row = dict[str, Any]


@contextmanager
def reading(db: Path, patience_s: float = PATIENCE_S) -> Iterator[duckdb.DuckDBPyConnection]:
    """Open the database for reading, for a moment; raises UsageError and StoreError.

    What lies there may be damaged, or have been made by another program.
    """
    try:
        with ALONE, read_database(db, patience_s=patience_s) as connection:
            yield connection
    except duckdb.Error as exc:
        raise UsageError(f"{db} cannot be read: {first_line(exc)}") from exc


def records(
    connection: duckdb.DuckDBPyConnection, sql: str, values: Mapping[str, object] | Sequence[object]
) -> list[Row]:
    """Return the rows of a query, by the names of their columns."""
    return list(by_name(connection.execute(sql, values)))
