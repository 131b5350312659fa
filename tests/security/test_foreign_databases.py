"""A database from elsewhere: its views and macros reach no file but the database itself."""

from __future__ import annotations

import duckdb
import pytest

from merge_runner.errors import UsageError
from merge_runner.results.database import read_database
from merge_runner.results.store import Store, query, results_digest

SECRET = "what nobody else may read"
PART = ("baseline", "--reps", 1, "--conditions", "N_0_0")
VIEW = (
    "ALTER TABLE trials RENAME TO theirs; CREATE VIEW trials AS SELECT theirs.* "
    "REPLACE ((SELECT content FROM read_text('{file}')) AS condition) FROM theirs"
)
# One file of the user's, by each of the ways in which a database can name it.
TRAPS = {
    "a view": VIEW,
    "a macro in place of a function": "CREATE MACRO max(a) AS "
    "(SELECT content FROM read_text('{file}'))",
    "a macro in place of the list of tables": "CREATE MACRO duckdb_tables() AS TABLE "
    "SELECT 'meta' AS table_name, content AS database_name FROM read_text('{file}')",
    "a view of the machine's files": "CREATE VIEW more AS FROM glob('{file}*')",
}
READS = {
    "a view": "SELECT condition FROM trials",
    "a macro in place of a function": "SELECT max(schema_version) FROM meta",
    "a macro in place of the list of tables": "SELECT * FROM duckdb_tables()",
    "a view of the machine's files": "FROM more",
}


@pytest.fixture
def secret(tmp_path):
    file = tmp_path / "diary.txt"
    file.write_text(SECRET)
    return file


def set_trap(db, trap, secret):
    with duckdb.connect(str(db)) as opened:
        opened.execute(TRAPS[trap].format(file=secret))


@pytest.fixture
def db(tmp_path):
    Store(tmp_path / "theirs.duckdb")
    return tmp_path / "theirs.duckdb"


@pytest.mark.parametrize("trap", TRAPS)
def test_no_file_that_a_database_names_is_read(db, secret, trap):
    set_trap(db, trap, secret)
    with duckdb.connect(str(db), read_only=True) as opened:
        opened.execute(READS[trap])  # which reads it, where nothing is done against it
    says = "has no columns in the table" if trap == "a view" else "files besides itself"
    with pytest.raises(UsageError, match=says), read_database(db) as opened:
        opened.execute(READS[trap]).fetchall()
    with pytest.raises(UsageError, match=says if trap == "a view" else "disabled"):
        query(db, READS[trap])


def test_one_database_after_the_other_is_read_and_neither_from_the_other(db, tmp_path):
    Store(tmp_path / "other.duckdb")
    for path in (db, tmp_path / "other.duckdb", db):
        assert results_digest(path)[1] == 0
        with pytest.raises(UsageError, match="files besides itself"), read_database(path) as opened:
            opened.execute(f"ATTACH '{tmp_path / 'third.duckdb'}'")
    assert not (tmp_path / "third.duckdb").exists()


async def test_no_command_shows_a_file_that_a_database_names(merge_runner, tmp_path, secret):
    assert (await merge_runner("sweep", *PART)).code == 0
    set_trap(tmp_path / "results/merge.duckdb", "a view", secret)
    for command in (("tables", "who-first"), ("report", "--out", "out.html"), ("sweep", *PART)):
        run = await merge_runner(*command)
        assert run.code == 2, command
        assert "has no columns in the table trials" in run.err
        assert SECRET not in run.out + run.err
        assert "Traceback" not in run.err
    assert not (tmp_path / "out.html").exists()


def change(db, sql):
    with duckdb.connect(str(db)) as opened:
        opened.execute(sql)


@pytest.mark.slow
@pytest.mark.parametrize("status", ["exploded", "", "<b>\n\x1b[2J" * 20])
async def test_a_status_that_no_trial_has_is_refused_in_one_line(merge_runner, tmp_path, status):
    assert (await merge_runner("sweep", *PART, "--model", "idm")).code == 0
    with duckdb.connect(str(tmp_path / "results/merge.duckdb")) as opened:
        opened.execute("UPDATE trials SET status = ?", [status])
    for command in (("tables",), ("report",), ("explain", "gap", "human/intercept:b")):
        run = await merge_runner(*command)
        assert (run.code, run.out) == (2, "")
        (line,) = run.err.splitlines()
        assert "idm/baseline/N_0_0/rep01 has the status " in line
        assert "valid: finished, collided, timeout, failed" in line
        assert line.isprintable()
        assert len(line) < 500


@pytest.mark.slow
@pytest.mark.xfail(
    strict=True,
    raises=AssertionError,
    reason="2.6: the name of a condition is part of a path as it is",
)
@pytest.mark.parametrize("name", ["a/b", "../up"])
async def test_no_name_of_a_condition_leads_out_of_the_folder_of_an_export(
    merge_runner, tmp_path, name
):
    if (await merge_runner("sweep", *PART, "--model", "constant")).code:
        pytest.fail("no trial is stored")
    change(tmp_path / "results/merge.duckdb", f"UPDATE trials SET condition = '{name}'")
    run = await merge_runner("view", "--trials", "*", "--export", "shared/pages")
    assert run.code == 0, run.err
    assert [path.name for path in (tmp_path / "shared").iterdir()] == ["pages"]
    pages = [path for path in (tmp_path / "shared/pages").iterdir() if path.is_file()]
    assert any("constant/baseline/N_0_0/rep01" in page.read_text() for page in pages)
