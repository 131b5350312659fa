"""Every table and view as Parquet and CSV, in a folder that explains itself."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import duckdb

from merge_runner.errors import StoreError, UsageError
from merge_runner.results.data_dictionary import SchemaTable, tables, units
from merge_runner.results.database import TEXTS, Instance, fetched, read_database
from merge_runner.results.provenance import program
from merge_runner.results.query_output import write_csv
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


def export_tables(db: Path, folder: Path) -> Iterator[Path]:
    """Write the folder; yields each path once it is written.

    Raises UsageError where the folder holds anything but an earlier export.
    """
    known = tables()
    _refuse_other_content(folder, known)
    try:
        with read_database(db, Instance(TEXTS, also=folder.resolve())) as connection:
            folder.mkdir(parents=True, exist_ok=True)
            yield _write_readme(folder / README, db, known)
            yield _write_dictionary(folder / DICTIONARY, known)
            for table in known:
                yield from _write_table(connection, folder, table.name)
    except OSError as exc:
        raise UsageError(f"{folder} cannot be written: {exc}") from exc
    except duckdb.Error as exc:
        raise StoreError(f"{db} cannot be exported: {first_line(exc)}") from exc


def _refuse_other_content(folder: Path, known: list[SchemaTable]) -> None:
    if folder.is_file():
        raise UsageError(f"{folder} is a file: name a folder")
    if not folder.is_dir():
        return
    ours = {README, DICTIONARY, *(f"{one.name}.{kind}" for one in known for kind in KINDS)}
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


def _write_table(connection: duckdb.DuckDBPyConnection, folder: Path, name: str) -> Iterator[Path]:
    parquet, csv = (folder / f"{name}.{kind}" for kind in KINDS)
    connection.execute(
        f"COPY (FROM {name}) TO {quoted(parquet.resolve())} (FORMAT parquet, COMPRESSION zstd)"
    )
    yield parquet
    result = connection.execute(f"FROM {name}")
    names = [column[0] for column in result.description or ()]
    with csv.open("w", encoding="utf-8", newline="") as out:
        write_csv(names, fetched(result), out)
    yield csv
