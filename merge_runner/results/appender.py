"""Rows that are added to tables of the results database."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from threading import Lock
from typing import Any

import duckdb

from merge_runner.results.database import SHARED

_ONE_AT_A_TIME = Lock()  # two threads may make a table of the same name


def append(
    connection: duckdb.DuckDBPyConnection, table: str, rows: Iterable[tuple[Any, ...]]
) -> None:
    """Add rows to a table."""
    if added := list(rows):
        appender = connection.appender(table)  # an INSERT would be a statement for each row
        appender.append_rows(added)
        appender.flush()


class Buffer:
    """Rows in DuckDB's memory that a transaction adds to tables of the database.

    To convert them takes as long as to add them, and needs no open file.
    """

    def __init__(self, columns: Mapping[str, Mapping[str, str]]) -> None:
        """Make a buffer for these tables, whose columns have these types."""
        self.cursor = SHARED.cursor()
        self._appenders = {
            table: _appender(self.cursor, table, types) for table, types in columns.items()
        }

    def add(self, rows: Mapping[str, Sequence[tuple[Any, ...]]]) -> None:
        """Add rows by table; rows of other tables are left out."""
        for table, appender in self._appenders.items():
            appender.append_rows(rows.get(table, ()))

    def flush(self) -> None:
        """Add the rows to the database that is open on the cursor."""
        for appender in self._appenders.values():
            appender.flush()

    def clear(self) -> None:
        """Forget the rows."""
        for appender in self._appenders.values():
            appender.clear()

    def close(self) -> None:
        """Forget the rows, and close the cursor."""
        self.clear()
        self.cursor.close()


def _appender(
    cursor: duckdb.DuckDBPyConnection, table: str, types: Mapping[str, str]
) -> duckdb.Appender:
    # DuckDB looks for the table now, in the instance's memory, and for that of the open database at
    # each flush. Without an open database, a flush is an error.
    columns = ", ".join(f"{name} {kind}" for name, kind in types.items())
    with _ONE_AT_A_TIME:
        cursor.execute(f"CREATE TABLE IF NOT EXISTS {table} ({columns}, CHECK (false))")
    return cursor.query_appender(f"INSERT INTO {table} FROM appender_data", dict(types))


def columns_of(connection: duckdb.DuckDBPyConnection, table: str) -> dict[str, str]:
    """Return the types of a table's columns by name."""
    relation = connection.table(table)
    return dict(zip(relation.columns, map(str, relation.types), strict=True))
