"""Tables and views with their columns, as their definitions in SQL explain them.

A comment above a table or a view explains that, one behind a column of a table or above a column of
a view explains the column. A column without one means what the first of its name does.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from functools import cache

import duckdb

from merge_runner.results.database import schema_sql

_BEGINS = re.compile(
    r"CREATE (?:TABLE IF NOT EXISTS|(?:OR REPLACE )?VIEW(?: IF NOT EXISTS)?) (\w+)"
)
_COLUMN = re.compile(r" {4}(\w+) [A-Z][^-]*(?:-- (.*))?")
_SELECTED = re.compile(r"(?:.* AS| {3}) (\w+),?")
_UNITS = {
    "mps2": "m/s²",
    "mps": "m/s",
    "m": "m",
    "s": "s",
    "usd": "USD",
    "tokens": "tokens",
    "at": "UTC",
}


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
    definitions = schema_sql()
    said = _comments(definitions)
    first: dict[str, str] = {}
    for columns in said.values():
        first = {**columns, **first}
    with duckdb.connect() as connection:
        connection.execute(definitions)
        found = connection.execute(
            "SELECT table_name, table_name IN (SELECT view_name FROM duckdb_views()), "
            "list((column_name, data_type) ORDER BY column_index) "
            "FROM duckdb_columns() WHERE NOT internal GROUP BY ALL"
        ).fetchall()
    order = list(said)
    made = [
        SchemaTable(
            name,
            is_view,
            said[name][""],
            [
                SchemaColumn(column, kind, said[name].get(column, first.get(column, "")))
                for column, kind in columns
            ],
        )
        for name, is_view, columns in found
    ]
    return sorted(made, key=lambda table: (table.is_view, order.index(table.name)))


def units() -> str:
    """What holds for all columns: the definitions' first line."""
    return schema_sql().partition("\n")[0].removeprefix("-- ")


def _comments(definitions: str) -> dict[str, dict[str, str]]:
    """What is said of each table, under an empty name, and of its columns."""
    said: dict[str, dict[str, str]] = {}
    above: list[str] = []
    columns: dict[str, str] = {}
    for line in definitions.splitlines():
        if line.lstrip().startswith("-- "):
            above.append(line.strip().removeprefix("-- "))
            continue
        if begins := _BEGINS.match(line):
            columns = said[begins[1]] = {"": " ".join(above)}
        elif (column := _COLUMN.fullmatch(line)) and column[2]:
            columns[column[1]] = column[2]
        elif above and (selected := _SELECTED.fullmatch(line)):
            columns[selected[1]] = " ".join(above)
        elif above and line.startswith("    "):
            continue  # the expression of the column goes on
        above = []
    return said
