"""``merge-runner sql`` reads the database, and reaches nothing else."""

from __future__ import annotations

import os
import shutil
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import ANY

import duckdb
import pytest

from merge_runner.errors import UsageError
from merge_runner.results.store import Store, query

DB = Path("results/merge.duckdb")


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A folder with a database and files that a query may be after."""
    folder = tmp_path_factory.mktemp("made")
    (folder / "private.csv").write_text("word\nprivate\n")
    (folder / "private.json").write_text('{"word": "private"}')
    with duckdb.connect() as connection:
        connection.execute(f"COPY (SELECT 'private' AS word) TO '{folder}/private.parquet'")
        connection.execute(
            f"ATTACH '{folder}/other.duckdb' AS other;"
            "CREATE TABLE other.t AS SELECT 'private' AS word"
        )
    Store(folder / DB)
    return folder


@pytest.fixture
def here(made, tmp_path, monkeypatch):
    """A copy of it, in which the program runs."""
    shutil.copytree(made, tmp_path, dirs_exist_ok=True)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("MERGE_RUNNER_TEST_SECRET", "in the environment")
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    return tmp_path


def contents(folder):
    return {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def answer(sql):
    """The rows, or the refusal."""
    try:
        return query(DB, sql)[1]
    except UsageError as exc:
        return exc


def is_refused(sql):
    """Whether the query is refused with a message that is short enough to read."""
    found = answer(sql)
    assert "Traceback" not in str(found)
    return isinstance(found, UsageError) and len(str(found).splitlines()) <= 6


READING_FILES = [
    "FROM 'private.csv'",
    "FROM 'private.parquet'",
    "FROM 'private.json'",
    "FROM 'other.duckdb'",
    "FROM read_csv('private.csv')",
    "FROM read_csv('/etc/passwd', sep = ':')",
    "FROM read_csv_auto('private.csv')",
    "FROM sniff_csv('private.csv')",
    "FROM read_json('private.json')",
    "FROM read_text('private.csv')",
    "FROM read_blob('private.csv')",
    "FROM read_blob('results/merge.duckdb')",
    "FROM read_duckdb('other.duckdb', table_name = 't')",
    "FROM read_parquet('private.parquet')",
    "FROM parquet_scan('private.parquet')",
    "FROM parquet_metadata('private.parquet')",
    "FROM parquet_schema('private.parquet')",
    "FROM parquet_kv_metadata('private.parquet')",
    "FROM glob('*')",
    "FROM glob('results/*')",
    "SELECT (SELECT content FROM read_text('private.csv'))",
    "WITH x AS (FROM read_text('private.csv')) FROM x",
    "PIVOT 'private.csv' ON word",
    "SUMMARIZE 'private.csv'",
    "DESCRIBE FROM 'private.csv'",
    "EXPLAIN ANALYZE SELECT * FROM 'private.csv'",
    "FROM query('FROM read_text(''private.csv'')')",
    "FROM query_table('private.csv')",
    "FROM 'http://127.0.0.1:9/x.parquet'",
    "FROM sqlite_scan('private.csv', 't')",
    "FROM sql_auto_complete('SEL')",
    "SELECT getenv('MERGE_RUNNER_TEST_SECRET')",
]
WRITING = [
    "COPY (SELECT 1) TO 'out.csv'",
    "COPY trials TO 'out.parquet'",
    "COPY (SELECT 1) TO '/dev/stdout'",
    # The database's own files stay open to a query that only lacks external access.
    "COPY (SELECT 1) TO 'results/merge.duckdb' (USE_TMP_FILE false)",
    "COPY (SELECT 1) TO 'results/merge.duckdb.wal'",
    "EXPLAIN ANALYZE COPY (SELECT 1) TO 'results/merge.duckdb.wal'",
    "EXPLAIN ANALYZE COPY (SELECT 1) TO 'results/merge.duckdb' (USE_TMP_FILE false)",
    "COPY (PIVOT meta ON schema_version) TO 'results/merge.duckdb.wal'",
    "EXPLAIN ANALYZE COPY (PIVOT meta ON schema_version) TO 'results/merge.duckdb.wal'",
    "COPY (SELECT 1) TO 'results/merge.duckdb.tmp/x.csv'",
    "EXPLAIN ANALYZE COPY (SELECT 1) TO 'results/merge.duckdb.tmp/x.csv'",
    "COPY meta FROM 'private.csv'",
    "COPY FROM DATABASE merge TO memory",
    "EXPORT DATABASE 'dump'",
    "EXPORT DATABASE 'results'",
    "IMPORT DATABASE 'dump'",
    "INSERT INTO meta VALUES (9)",
    "UPDATE meta SET schema_version = 9",
    "DELETE FROM meta",
    "TRUNCATE meta",
    "DROP TABLE meta",
    "DROP VIEW trial_metrics",
    "ALTER TABLE meta ADD COLUMN x INTEGER",
    "COMMENT ON TABLE meta IS 'x'",
    "MERGE INTO meta USING (SELECT 9 AS v) ON false WHEN NOT MATCHED THEN INSERT VALUES (v)",
    "WITH x AS (INSERT INTO meta VALUES (9) RETURNING *) FROM x",
    "EXPLAIN ANALYZE INSERT INTO meta VALUES (9)",
    "CREATE TABLE t AS SELECT 1",
    "CREATE TABLE t AS PIVOT meta ON schema_version",
    "CREATE VIEW v AS SELECT 1",
    "CREATE MACRO f(a) AS a",
    "CREATE SEQUENCE s",
    "CREATE PERSISTENT SECRET s (TYPE s3, KEY_ID 'a', SECRET 'b')",
]
CHANGING_THE_PROGRAM = [
    "INSTALL httpfs",
    "LOAD httpfs",
    "LOAD './private.duckdb_extension'",
    "UPDATE EXTENSIONS",
    "ATTACH 'other.duckdb'",
    "ATTACH 'new.duckdb'",
    "ATTACH ':memory:' AS m",
    "ATTACH 'results/merge.duckdb' AS again",
    "ATTACH 'results/merge.duckdb' AS again (READ_WRITE)",
    "DETACH merge",
    "USE memory",
    "SET enable_external_access = true",
    "SET lock_configuration = false",
    "SET disabled_filesystems = ''",
    "SET temp_directory = 'x'",
    "SET threads = 1",
    "SET VARIABLE x = 1",
    "RESET enable_external_access",
    "RESET disabled_filesystems",
    "PRAGMA threads = 1",
    "PRAGMA enable_profiling",
    "PRAGMA database_list",
    "PRAGMA import_database('dump')",
    "CALL enable_logging()",
    "CALL force_checkpoint()",
    "CHECKPOINT",
    "VACUUM",
    "BEGIN TRANSACTION",
    "PREPARE p AS INSERT INTO meta VALUES (9)",
    "EXECUTE p",
]
SEVERAL = [
    "SELECT 1; SELECT 2",
    "SELECT 1; INSERT INTO meta VALUES (9); SELECT 2",
    "SELECT 1; COPY (SELECT 1) TO 'results/merge.duckdb.wal'; SELECT 2",
    "SELECT 1; SET enable_external_access = true; FROM 'private.csv'",
    "BEGIN; DELETE FROM meta; COMMIT",
    "ROLLBACK; INSERT INTO meta VALUES (9)",
    "PREPARE p AS SELECT 1; EXECUTE p",
    "SELECT 1; /* -- */ ATTACH 'new.duckdb'",
]
NO_QUERY = ["", " ", "-- nothing", ";", "SELEKT", "SELECT ?", "SELECT $x", "SELECT 1 FROM nowhere"]


@pytest.mark.long
@pytest.mark.parametrize(
    "queries",
    [READING_FILES, WRITING, CHANGING_THE_PROGRAM, SEVERAL, NO_QUERY],
    ids=["reading files", "writing", "changing the program", "several", "no query"],
)
def test_what_is_more_than_one_query_of_the_database_is_refused_and_changes_nothing(here, queries):
    before = contents(here)
    assert [sql for sql in queries if not is_refused(sql)] == []
    assert contents(here) == before


@pytest.mark.long
def test_each_setting_alone_holds_where_a_statement_slips_through(here, monkeypatch):
    """As if the check of statements let everything pass."""
    reading = SimpleNamespace(SELECT=ANY, EXPLAIN=ANY, MULTI=ANY)
    monkeypatch.setattr("merge_runner.results.store.duckdb.StatementType", reading)
    before = contents(here)
    harmless = {
        *("USE memory", "SET VARIABLE x = 1", "CHECKPOINT", "VACUUM", "BEGIN TRANSACTION"),
        *("PRAGMA database_list", "PREPARE p AS INSERT INTO meta VALUES (9)"),
        "ATTACH ':memory:' AS m",
    }
    queries = {*READING_FILES, *WRITING, *CHANGING_THE_PROGRAM} - harmless
    assert [sql for sql in queries if not is_refused(sql)] == []
    assert contents(here) == before


def test_the_settings_that_hold_where_duckdb_has_more_ways_out_than_are_listed_here(here):
    settings = {
        "enable_external_access": "false",
        "lock_configuration": "true",
        "temp_directory": "",
    }
    found = dict(query(DB, "SELECT name, value FROM duckdb_settings()")[1])
    assert {name: found[name] for name in settings} == settings


def test_the_environment_and_the_program_s_variables_are_out_of_reach(here):
    for sql in (
        "FROM path",
        "FROM sql",
        "FROM connection",
        "FROM os",
        "SELECT current_setting('x')",
    ):
        assert is_refused(sql)
    for sql in ("FROM duckdb_settings()", "FROM duckdb_secrets()", "FROM duckdb_variables()"):
        assert os.environ["MERGE_RUNNER_TEST_SECRET"] not in str(query(DB, sql))


@pytest.mark.parametrize(
    ("sql", "rows"),
    [
        ("SELECT count(*) FROM trials", [(0,)]),
        ("select 1;", [(1,)]),
        ("/* one */ SELECT 1 -- ; two", [(1,)]),
        ("FROM range(2)", [(0,), (1,)]),
        ("VALUES (1)", [(1,)]),
        ("WITH x AS (SELECT 1) FROM x", [(1,)]),
        ("SELECT ';INSERT INTO meta VALUES (9);'", [(";INSERT INTO meta VALUES (9);",)]),
        ("SELECT now()::TIMESTAMP < '2000-01-01'", [(False,)]),
    ],
)
def test_a_query_is_answered(here, sql, rows):
    assert query(DB, sql)[1] == rows


@pytest.mark.parametrize(
    "sql",
    [
        "DESCRIBE trials",
        "SHOW TABLES",
        "SUMMARIZE meta",
        "EXPLAIN SELECT 1",
        "TABLE meta",
        "PIVOT meta ON schema_version USING count(*)",
        "SELECT * FROM trial_metrics JOIN trials USING (trial_id, spec_hash)",
    ],
)
def test_every_form_of_a_query_works(here, sql):
    assert query(DB, sql)[0]


@pytest.mark.parametrize(
    ("sql", "says"),
    [
        ("SELECT 1; SELECT 2", "one query at a time"),
        ("", "one query at a time"),
        ("DROP TABLE meta", "one that only reads: SELECT, "),
        ("FROM 'private.csv'", "LocalFileSystem has been disabled"),
        ("SELEKT", "syntax error at or near"),
    ],
)
def test_a_refusal_says_what_is_wrong(here, sql, says):
    with pytest.raises(UsageError) as refusal:
        query(DB, sql)
    assert says in str(refusal.value)


async def test_the_program_refuses_with_a_line_and_no_traceback(here, merge_runner):
    for sql, lines in (("DROP TABLE meta", 1), ("FROM read_text('private.csv')", 4), ("", 1)):
        run = await merge_runner("sql", sql)
        assert (run.code, run.out) == (2, "")
        assert run.err.startswith("error: ")
        assert len(run.err.splitlines()) <= lines
        assert "Traceback" not in run.err
