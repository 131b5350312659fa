"""Every table and view as Parquet and CSV, in a folder that explains itself."""

from __future__ import annotations

import shutil
from collections.abc import Iterator, Sequence
from pathlib import Path

import duckdb

from merge_runner.errors import StoreError, UsageError
from merge_runner.results.data_dictionary import SchemaColumn, SchemaTable, tables, units
from merge_runner.results.database import fetched, names_of, read_database
from merge_runner.results.provenance import program
from merge_runner.results.query_output import write_csv
from merge_runner.results.wide_trials import (
    COMMENT,
    FACTORS,
    NAME,
    fixed_columns,
    wide_trials,
)
from merge_runner.text_safety import first_line, quoted

TITLE = "# Results of merge-runner"
README, DICTIONARY = "README.md", "dictionary.csv"
KINDS = ("parquet", "csv")
HEADINGS = ["table", "column", "type", "unit", "meaning"]
EXPLAINED = """
The tables and views of `{name}`, each as Parquet and as CSV, written by {program}.
`dictionary.csv` explains each column. {units} In CSV, a text that a
spreadsheet would take for a formula has an apostrophe before it; in Parquet it is as it was.

| table | what it holds |
|---|---|
"""


def export_tables(
    db: Path, folder: Path, also: Sequence[tuple[SchemaTable, Path]] = ()
) -> Iterator[Path]:
    """Write the folder, with tables ``also`` that are CSV files; yields each path once written.

    Raises UsageError where the folder holds anything but an earlier export.
    """
    try:
        with read_database(db) as connection:
            wide = wide_trials(connection.execute(FACTORS.format(only="")).fetchall())
            known = [*tables(), *(table for table, _ in also), _described(connection, wide)]
            _refuse_other_content(folder, [table.name for table in known])
            folder.mkdir(parents=True, exist_ok=True)
            yield _write_readme(folder / README, db, known)
            yield _write_dictionary(folder / DICTIONARY, known)
            for table in tables():
                yield from _write_table(connection, folder, table.name, f"FROM {table.name}")
            yield from _write_table(connection, folder, NAME, wide)
            for table, file in also:
                yield shutil.copyfile(file, copy := folder / f"{table.name}.csv")
                rows = f"FROM read_csv({quoted(copy.resolve())})"
                yield _write_parquet(connection, folder, table.name, rows)
    except OSError as exc:
        raise UsageError(f"{folder} cannot be written: {exc}") from exc
    except duckdb.Error as exc:
        raise StoreError(f"{db} cannot be exported: {first_line(exc)}") from exc


def _described(connection: duckdb.DuckDBPyConnection, wide: str) -> SchemaTable:
    """The columns of the wide trials; what no table has is a factor."""
    known = {column.name: column for column in fixed_columns()}
    columns = [
        known.get(name, SchemaColumn(name, kind, "the level of a factor of the study"))
        for name, kind, *_ in connection.execute(f"DESCRIBE {wide}").fetchall()
    ]
    return SchemaTable(NAME, is_view=True, comment=COMMENT, columns=columns)


def _refuse_other_content(folder: Path, names: Sequence[str]) -> None:
    if folder.is_file():
        raise UsageError(f"{folder} is a file: name a folder")
    if not folder.is_dir():
        return
    ours = {README, DICTIONARY, *(f"{name}.{kind}" for name in names for kind in KINDS)}
    there = sorted(path.name for path in folder.iterdir())
    foreign = [name for name in there if name not in ours]
    if README in there and not (folder / README).read_bytes().startswith(TITLE.encode()):
        foreign.append(README)
    if foreign or (there and README not in there):
        raise UsageError(
            f"{folder} holds {(foreign or there)[0]}, which is no export's: name another folder"
        )


def _write_readme(path: Path, db: Path, known: list[SchemaTable]) -> Path:
    rows = [f"| `{one.name}`{' (view)' * one.is_view} | {one.comment} |" for one in known]
    said = EXPLAINED.format(name=db.name, program=program(), units=units())
    path.write_text("\n".join([TITLE, said.rstrip("\n"), *rows, ""]), encoding="utf-8")
    return path


def _write_dictionary(path: Path, known: list[SchemaTable]) -> Path:
    rows = (
        (table.name, column.name, column.kind, column.unit, column.comment)
        for table in known
        for column in table.columns
    )
    with path.open("w", encoding="utf-8", newline="") as out:
        write_csv(HEADINGS, rows, out)
    return path


def _write_table(
    connection: duckdb.DuckDBPyConnection, folder: Path, name: str, query: str
) -> Iterator[Path]:
    yield _write_parquet(connection, folder, name, query)
    result = connection.execute(query)
    names = names_of(result)
    with (csv := folder / f"{name}.csv").open("w", encoding="utf-8", newline="") as out:
        write_csv(names, fetched(result), out)
    yield csv


def _write_parquet(
    connection: duckdb.DuckDBPyConnection, folder: Path, name: str, query: str
) -> Path:
    path = folder / f"{name}.parquet"
    connection.execute(
        f"COPY ({query}) TO {quoted(path.resolve())} (FORMAT parquet, COMPRESSION zstd)"
    )
    return path
