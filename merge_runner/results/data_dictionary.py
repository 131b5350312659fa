"""Tables and views with their columns, as the comments of the schema explain them."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import duckdb

from merge_runner.results.database import schema_sql

_UNITS = {
    "mps2": "m/s²",
    "mps": "m/s",
    "m": "m",
    "s": "s",
    "usd": "USD",
    "tokens": "tokens",
    "at": "UTC",
}
# A column without a comment means what the first of its name does.
_DESCRIBED = """
WITH relations AS (
    SELECT table_oid AS oid, table_name AS name, comment, false AS is_view, database_name
    FROM duckdb_tables()
    UNION ALL
    SELECT view_oid, view_name, comment, true, database_name FROM duckdb_views() WHERE NOT internal
), columns AS (
    SELECT *, coalesce(comment, arg_min(comment, table_oid) OVER (PARTITION BY column_name), '')
        AS meaning
    FROM duckdb_columns()
    WHERE NOT internal AND database_name IN (current_database(), 'temp')
)
SELECT name, is_view, relations.comment,
    list((column_name, data_type, meaning) ORDER BY column_index)
FROM relations JOIN columns ON oid = table_oid AND relations.database_name = columns.database_name
GROUP BY oid, name, is_view, relations.comment ORDER BY is_view, oid
"""


@dataclass(frozen=True, slots=True)
class SchemaColumn:
    """A column, its type, and what is said of it."""

    name: str
    kind: str
    comment: str

    @property
    def unit(self) -> str:
        """As the end of its name says it; empty: it has none."""
        return _UNITS.get(self.name.rpartition("_")[2], "") if "_" in self.name else ""


@dataclass(frozen=True, slots=True)
class SchemaTable:
    """A table or a view."""

    name: str
    is_view: bool
    comment: str
    columns: list[SchemaColumn]


@cache
def tables() -> list[SchemaTable]:
    """Tables, then views, in the order of their definitions."""
    with duckdb.connect() as connection:
        connection.execute(schema_sql())
        return described(connection)


def described(connection: duckdb.DuckDBPyConnection) -> list[SchemaTable]:
    """The tables and views of an open database, and the temporary ones of the connection."""
    return [
        SchemaTable(name, is_view, comment, [SchemaColumn(*column) for column in columns])
        for name, is_view, comment, columns in connection.execute(_DESCRIBED).fetchall()
    ]


def units() -> str:
    """What holds for all columns: the definitions' first line."""
    return schema_sql().partition("\n")[0].removeprefix("-- ")
