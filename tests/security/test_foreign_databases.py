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
