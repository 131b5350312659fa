"""Which version of the measures a database has."""

import importlib
import re
from pathlib import Path

import duckdb

from merge_runner.results.store import Store, query
from merge_runner.scenarios.merge import measures


def test_a_remark_is_no_other_version_of_the_measures_and_a_definition_is(monkeypatch):
    read = Path.read_text

    def version(added):
        monkeypatch.setattr(Path, "read_text", lambda self, **how: read(self, **how) + added)
        return importlib.reload(measures).measures_version()

    comment = "COMMENT ON VIEW trial_metrics IS 'what it means';\n"
    (same,) = {*map(version, ("", "-- A remark.\n", "    -- Another one.\n", comment))}
    assert version("SELECT 1;\n") != same
    assert version("") == same


def test_no_mean_depends_on_the_order_in_which_threads_add():
    """Floating-point sums in another order end in another digit."""
    text = Path(measures.__file__).with_name("measures.sql").read_text()
    nested = r"\((?:[^()]|\((?:[^()]|\([^()]*\))*\))*\)"
    sums = re.findall(rf"\b(?:avg|sum){nested}", text)
    assert len(sums) == 2
    assert all("ORDER BY step" in each for each in sums)


async def test_older_measures_are_told_to_a_reader_and_replaced_when_the_database_is_written_to(
    merge_runner, tmp_path
):
    path = tmp_path / "t.duckdb"
    Store(path)
    with duckdb.connect(str(path)) as connection:
        connection.execute("CREATE OR REPLACE VIEW trial_metrics AS SELECT 1 AS old")
        connection.execute("CREATE OR REPLACE MACRO measures_version() AS 'another'")
    asked = ("sql", "FROM trial_metrics", "--db", path)
    told = await merge_runner(*asked)
    assert (told.code, told.out.split()[0]) == (0, "old")
    assert told.err.count("another version of the program defined the measures") == 1
    assert "`merge-runner sweep` into it brings them up to date" in told.err
    Store(path)
    assert "gap_m" in query(path, "FROM trial_metrics")[0]
    assert (await merge_runner(*asked)).err == ""
