"""``merge-runner sql`` reads the database, and reaches nothing else."""

import os
import re
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import ANY

import duckdb
import pytest

from merge_runner.errors import UsageError
from merge_runner.results.store import Store, query
from tests.support.harness import PROJECT, contents

DB = Path("results/merge.duckdb")
CASES = {
    title: queries.strip().splitlines()
    for title, queries in re.findall(
        r"^-- (.*)\n((?:(?!--).+\n)+)",
        (PROJECT / "tests/cases/hostile_sql.txt").read_text(),
        re.MULTILINE,
    )
}
# What the settings refuse, too, where a check of statements would let it through.
WITHIN_SETTINGS = ("reading files", "writing", "changing the program")


@pytest.fixture(scope="module")
def here(tmp_path_factory):
    """A folder with a database and files that a query may be after, in which the program runs."""
    folder = tmp_path_factory.mktemp("here")
    (folder / "private.csv").write_text("word\nprivate\n")
    (folder / "private.json").write_text('{"word": "private"}')
    with duckdb.connect() as connection:
        connection.execute(f"COPY (SELECT 'private' AS word) TO '{folder}/private.parquet'")
        connection.execute(
            f"ATTACH '{folder}/other.duckdb' AS other;"
            "CREATE TABLE other.t AS SELECT 'private' AS word"
        )
    Store(folder / DB)
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        patch.setenv("MERGE_RUNNER_TEST_SECRET", "in the environment")
        patch.setenv("HOME", str(folder / "home"))
        yield folder


@pytest.fixture
def unchanged(here):
    before = contents(here)
    yield
    assert contents(here) == before


def refusal(sql):
    """What is said, which is short enough to read."""
    with pytest.raises(UsageError) as refused:
        query(DB, sql)
    said = str(refused.value)
    assert "Traceback" not in said
    assert len(said.splitlines()) <= 6
    return said


@pytest.mark.parametrize("sql", [*(sql for each in CASES.values() for sql in each), "", " "])
def test_what_is_more_than_one_query_of_the_database_is_refused_and_changes_nothing(unchanged, sql):
    refusal(sql)


@pytest.mark.parametrize("sql", [sql for title in WITHIN_SETTINGS for sql in CASES[title]])
def test_each_setting_alone_holds_where_a_statement_slips_through(unchanged, monkeypatch, sql):
    """As if the check of statements let everything pass."""
    reading = SimpleNamespace(SELECT=ANY, EXPLAIN=ANY, MULTI=ANY)
    monkeypatch.setattr("merge_runner.results.store.duckdb.StatementType", reading)
    refusal(sql)


def test_the_settings_that_hold_where_duckdb_has_more_ways_out_than_are_listed_here(here):
    found = dict(query(DB, "SELECT name, value FROM duckdb_settings()")[1])
    names = ("enable_external_access", "lock_configuration", "temp_directory")
    assert [found[name] for name in names] == ["false", "true", ""]


def test_the_environment_and_the_program_s_variables_are_out_of_reach(here):
    for sql in ("FROM path", "FROM connection", "SELECT current_setting('x')"):
        refusal(sql)
    for sql in ("FROM duckdb_settings()", "FROM duckdb_secrets()", "FROM duckdb_variables()"):
        assert os.environ["MERGE_RUNNER_TEST_SECRET"] not in str(query(DB, sql))


@pytest.mark.parametrize(
    ("sql", "rows"),
    [
        ("/* one */ SELECT 1 -- ; two", [(1,)]),
        ("FROM range(2);", [(0,), (1,)]),
        ("VALUES (1)", [(1,)]),
        ("WITH x AS (SELECT 1) FROM x", [(1,)]),
        ("SELECT ';INSERT INTO meta VALUES (9);'", [(";INSERT INTO meta VALUES (9);",)]),
        ("SELECT now()::TIMESTAMP < '2000-01-01'", [(False,)]),
        ("SELECT * FROM trial_metrics JOIN trials USING (trial_id, spec_hash)", []),
        *((sql, ANY) for sql in ("DESCRIBE trials", "SHOW TABLES", "SUMMARIZE meta")),
        *((sql, ANY) for sql in ("EXPLAIN SELECT 1", "PIVOT meta ON schema_version")),
    ],
)
def test_a_query_of_any_form_is_answered(here, sql, rows):
    assert query(DB, sql)[1] == rows


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
    assert says in refusal(sql)


async def test_the_program_refuses_with_a_line_and_no_traceback(here, merge_runner):
    run = await merge_runner("sql", "DROP TABLE meta", cwd=here)
    assert (run.code, run.out, len(run.err.splitlines())) == (2, "", 1)
    assert run.err.startswith("error: ")
