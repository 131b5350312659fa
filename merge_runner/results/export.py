"""Every table and view as Parquet and CSV, in a folder that explains itself."""

from __future__ import annotations

import shutil
from collections.abc import Iterator, Sequence
from pathlib import Path

import duckdb

from merge_runner.errors import StoreError, UsageError
from merge_runner.results.data_dictionary import SchemaTable, described, units
from merge_runner.results.database import fetched, names_of, read_database
from merge_runner.results.provenance import program
from merge_runner.results.query_output import Rows, write_csv
from merge_runner.results.wide_trials import COMMENT, FACTORS, NAME, wide_trials
from merge_runner.text_safety import first_line, quoted

TITLE = "# Results of merge-runner"
README, DICTIONARY = "README.md", "dictionary.csv"
OF_A_FACTOR = "the level of a factor of the study"  # what no other table has
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
    _refuse_other_content(folder)
    try:
        with read_database(db) as connection:
            factors = connection.execute(FACTORS.format(only="")).fetchall()
            connection.execute(f"CREATE OR REPLACE TEMP VIEW {NAME} AS {wide_trials(factors)}")
            connection.execute(f"COMMENT ON VIEW {NAME} IS {quoted(COMMENT)}")
            stored = described(connection)
            known = [*stored, *(table for table, _ in also)]
            folder.mkdir(parents=True, exist_ok=True)
            rows = [f"| `{t.name}`{' (view)' * t.is_view} | {t.comment} |" for t in known]
            said = EXPLAINED.format(name=db.name, program=program(), units=units())
            text = "\n".join([TITLE, said.rstrip("\n"), *rows, ""])
            (folder / README).write_text(text, encoding="utf-8")
            yield folder / README
            meanings = (
                (table.name, column.name, column.kind, column.unit, column.comment or otherwise)
                for table in known
                for otherwise in [OF_A_FACTOR if table.name == NAME else ""]
                for column in table.columns
            )
            yield _write_csv(folder / DICTIONARY, HEADINGS, meanings)
            for table in stored:
                query = f"FROM {table.name}"
                yield _write_parquet(connection, folder / f"{table.name}.parquet", query)
                result = connection.execute(query)
                yield _write_csv(folder / f"{table.name}.csv", names_of(result), fetched(result))
            for table, file in also:
                yield shutil.copyfile(file, copy := folder / f"{table.name}.csv")
                query = f"FROM read_csv({quoted(copy.resolve())})"
                yield _write_parquet(connection, folder / f"{table.name}.parquet", query)
    except OSError as exc:
        raise UsageError(f"{folder} cannot be written: {exc}") from exc
    except duckdb.Error as exc:
        raise StoreError(f"{db} cannot be exported: {first_line(exc)}") from exc


def _refuse_other_content(folder: Path) -> None:
    there = folder.exists() and (not folder.is_dir() or any(folder.iterdir()))
    readme = folder / README
    if there and not (readme.is_file() and readme.read_bytes().startswith(TITLE.encode())):
        raise UsageError(f"{folder} is there and no earlier export: name another folder")


def _write_csv(path: Path, names: list[str], rows: Rows) -> Path:
    with path.open("w", encoding="utf-8", newline="") as out:
        write_csv(names, rows, out)
    return path


def _write_parquet(connection: duckdb.DuckDBPyConnection, path: Path, query: str) -> Path:
    options = "FORMAT parquet, COMPRESSION zstd"
    connection.execute(f"COPY ({query}) TO {quoted(path.resolve())} ({options})")
    return path
