"""Rows as a table, CSV or JSON, and every table of a database as Parquet and CSV."""

from __future__ import annotations

import json
from collections.abc import Iterable, Sequence
from functools import cache
from itertools import chain
from pathlib import Path
from tempfile import TemporaryFile
from typing import Any, NamedTuple, TextIO

import duckdb

from merge_runner.errors import StoreError, UsageError
from merge_runner.results.database import (
    fetched,
    names_of,
    of_sweeps,
    only,
    read_database,
    schema_sql,
)
from merge_runner.text_safety import csv_writer, first_line, in_spreadsheet, printable, quoted

Rows = Iterable[tuple[Any, ...]]
# A column without a comment has the meaning of the first column with its name.
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
# Each factor with the common type of its levels, which are written by ``level_text``.
FACTOR_TYPES = """
SELECT factor, CASE
    WHEN bool_and(kind = 'BOOLEAN') THEN 'BOOLEAN'
    WHEN bool_and(kind LIKE '%BIGINT' AND try_cast(value AS BIGINT) IS NOT NULL) THEN 'BIGINT'
    WHEN bool_and(kind LIKE '%BIGINT' OR kind = 'DOUBLE') THEN 'DOUBLE'
    ELSE 'VARCHAR' END AS type
FROM (
    SELECT factor, value, CASE WHEN json_valid(value) THEN json_type(value) ELSE '' END AS kind
    FROM trial_factors {only}
)
GROUP BY factor ORDER BY factor
"""
WIDE_QUERY = """
SELECT trials.*, trial_drivers.* EXCLUDE (trial_id, spec_hash),
    trial_metrics.* EXCLUDE (trial_id, spec_hash), levels.* EXCLUDE (trial_id, spec_hash)
FROM trials {only}
LEFT JOIN trial_drivers USING (trial_id, spec_hash)
LEFT JOIN trial_metrics USING (trial_id, spec_hash)
LEFT JOIN (SELECT trial_id, spec_hash{levels} FROM trial_factors GROUP BY ALL) AS levels
    USING (trial_id, spec_hash)
ORDER BY trial_id, spec_hash
"""
WIDE_NAME = "trials_wide"
WIDE_COMMENT = (
    "One row a trial: trials, trial_drivers, trial_metrics, and a column for each factor."
)
DICTIONARY = "dictionary.csv"
LEVEL_MEANING = "the level of a factor of the study"  # of columns that no other table has
HEADINGS = ["table", "column", "type", "meaning"]


class SchemaColumn(NamedTuple):
    """Column with its type and comment; the end of its name is the unit."""

    name: str
    kind: str
    comment: str


class SchemaTable(NamedTuple):
    """Table or view with its columns."""

    name: str
    is_view: bool
    comment: str
    columns: list[SchemaColumn]


@cache
def tables() -> list[SchemaTable]:
    """Return the tables, then the views, in the order of their definitions."""
    with duckdb.connect() as connection:
        connection.execute(schema_sql())
        return described(connection)


def described(connection: duckdb.DuckDBPyConnection) -> list[SchemaTable]:
    """Return the tables and views of an open database, including temporary ones."""
    return [
        SchemaTable(name, is_view, comment, [SchemaColumn(*column) for column in columns])
        for name, is_view, comment, columns in connection.execute(_DESCRIBED).fetchall()
    ]


def units() -> str:
    """Return the first line of the schema, which has the units of all columns."""
    return schema_sql().partition("\n")[0].removeprefix("-- ")


def wide_trials(factors: Iterable[tuple[str, str]], sweep_ids: Sequence[str] | None) -> str:
    """Return the SQL of the trials with their FACTOR_TYPES as columns; of some sweeps, or of all.

    A factor with the name of another column gets the prefix ``factor_``.
    """
    relations = ("trials", "trial_drivers", "trial_metrics")
    fixed = (table.columns for table in tables() if table.name in relations)
    taken, levels = {column.name for column in chain.from_iterable(fixed)}, ""
    for factor, kind in factors:
        name = f"factor_{factor}" if factor.lower() in taken else factor
        column = '"' + name.replace('"', '""') + '"'
        levels += f", max(value) FILTER (factor = {quoted(factor)})::{kind} AS {column}"
    return WIDE_QUERY.format(levels=levels, only=only(sweep_ids))


def export_tables(db: Path, folder: Path, sweep_ids: Sequence[str] | None) -> None:
    """Write a folder with all rows, or only with some sweeps and their trials.

    The dictionary has the meaning of each column and, in a row without a column, of each table.
    Raises UsageError if the folder has content that is not an earlier export.
    """
    dictionary, first = folder / DICTIONARY, ",".join(HEADINGS).encode()
    has_content = folder.exists() and (not folder.is_dir() or any(folder.iterdir()))
    if has_content and not (dictionary.is_file() and dictionary.read_bytes().startswith(first)):
        raise UsageError(f"{folder} is there and no earlier export: name another folder")
    try:
        with read_database(db) as connection:
            factors = connection.execute(FACTOR_TYPES.format(only=only(sweep_ids))).fetchall()
            wide = wide_trials(factors, sweep_ids)
            connection.execute(f"CREATE OR REPLACE TEMP VIEW {WIDE_NAME} AS {wide}")
            connection.execute(f"COMMENT ON VIEW {WIDE_NAME} IS {quoted(WIDE_COMMENT)}")
            tables = described(connection)
            levels = {
                (WIDE_NAME, name): LEVEL_MEANING
                for factor, _ in factors
                for name in (factor, f"factor_{factor}")
            }
            folder.mkdir(parents=True, exist_ok=True)
            meanings = [
                (table.name, *column)
                for table in tables
                for column in [
                    ("", "", table.comment),
                    *(
                        (c.name, c.kind, c.comment or levels.get((table.name, c.name), ""))
                        for c in table.columns
                    ),
                ]
            ]
            _write_csv(dictionary, HEADINGS, meanings)
            for table in tables:
                query = f"FROM {table.name} {_rows_of(sweep_ids, table)}"
                parquet = quoted((folder / f"{table.name}.parquet").resolve())
                options = "FORMAT parquet, COMPRESSION zstd"
                connection.execute(f"COPY ({query}) TO {parquet} ({options})")
                result = connection.execute(query)
                _write_csv(folder / f"{table.name}.csv", names_of(result), fetched(result))
    except OSError as exc:
        raise UsageError(f"{folder} cannot be written: {exc}") from exc
    except duckdb.Error as exc:
        raise StoreError(f"{db} cannot be exported: {first_line(exc)}") from exc


def _rows_of(sweep_ids: Sequence[str] | None, table: SchemaTable) -> str:
    """Return the SQL clause that selects the rows of these sweeps, their trials or their specs."""
    names = {column.name for column in table.columns}
    if sweep_ids is None or not names & {"sweep_id", "spec_hash"}:
        return ""
    if "sweep_id" in names:
        return f"WHERE {of_sweeps(sweep_ids)}"
    if "trial_id" in names:
        return only(sweep_ids)
    trials = f"FROM sweep_trials WHERE {of_sweeps(sweep_ids)}"
    return f"SEMI JOIN ({trials}) USING (spec_hash)"


def _write_csv(path: Path, names: list[str], rows: Rows) -> None:
    with path.open("w", encoding="utf-8", newline="") as out:
        write_csv(names, rows, out)


def write_csv(names: list[str], rows: Rows, out: TextIO) -> None:
    """Write CSV without cells that a spreadsheet would run as a formula."""
    csv_writer(out).writerows(map(in_spreadsheet, row) for row in chain((names,), rows))


def write_json(names: list[str], rows: Rows, out: TextIO) -> None:
    """Write an array of objects."""
    if len(set(names)) < len(names):
        twice = next(name for name in names if names.count(name) > 1)
        raise UsageError(f"two columns are named {twice!r}: name them apart with AS")
    before = "["
    for row in rows:
        record = dict(zip(names, row, strict=True))
        text = json.dumps(record, indent=2, default=str, ensure_ascii=False)
        out.write(f"{before}\n  " + printable(text.replace("\n", "\n  ")))
        before = ","
    out.write("[]\n" if before == "[" else "\n]\n")


def write_table(names: list[str], rows: Rows, out: TextIO) -> None:
    """Write columns as wide as their widest cell, via a file to save memory."""
    widths = [0] * len(names)
    with TemporaryFile("w+", encoding="utf-8", errors="surrogatepass") as lines:
        for row in chain((names,), rows):
            cells = ["" if value is None else str(value) for value in row]
            widths = [max(width, len(cell)) for width, cell in zip(widths, cells, strict=True)]
            lines.write(json.dumps(cells) + "\n")
        lines.seek(0)
        for line in lines:
            padded = map(str.ljust, json.loads(line), widths)
            out.write(printable("  ".join(padded).rstrip()) + "\n")
