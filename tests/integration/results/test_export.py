"""The exported folder: every table and view, explained, and nothing of anybody else's replaced."""

import csv

import duckdb
import pytest

from merge_runner.results.export import FACTOR_TYPES, tables
from merge_runner.results.recording import COLUMNS
from merge_runner.results.store import query
from tests.support import cases
from tests.support.harness import PROJECT
from tests.support.studies import write_study, yielding


def rows(path):
    csv.field_size_limit(2**24)  # the golden study has a long reply
    with path.open(newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


@pytest.fixture(scope="module")
def exported(prepare, golden, tmp_path_factory):
    """The folder of an export that has replaced an earlier one."""
    folder = tmp_path_factory.mktemp("exported")
    earlier = write_study(folder / "earlier.duckdb", yielding("m", reps=1))
    for db in (earlier, golden / "golden.duckdb"):
        run = prepare(folder, "export", "out", "--db", db)
        said = "wrote every table into out: begin with out/dictionary.csv\n"
        assert (run.code, run.out, run.err) == (0, said, "")
    return folder / "out"


def test_every_table_and_view_is_written_as_parquet_and_csv(exported, golden):
    dictionary = rows(exported / "dictionary.csv")
    for table in tables():
        ((there,),) = query(golden / "golden.duckdb", f"SELECT count(*) FROM {table.name}")[1]
        parquet = duckdb.read_parquet(str(exported / f"{table.name}.parquet"))
        assert parquet.shape == (there, len(table.columns))
        assert len(rows(exported / f"{table.name}.csv")) == there
        told = [row["column"] for row in dictionary if row["table"] == table.name]
        assert told == ["", *parquet.columns]
    meanings = {(r["table"], r["column"]): (r["type"], r["meaning"]) for r in dictionary}
    kind, meaning = meanings["trial_metrics", "gap_m"]
    assert (kind, meaning[:9]) == ("DOUBLE", "net gap, ")
    assert meanings["perceptions", "distance_m"][1].startswith("true distance to the other")


def test_the_wide_trials_have_metrics_and_typed_factors_and_humans_stand_beside_them(
    exported, golden
):
    wide = duckdb.read_parquet(str(exported / "trials_wide.parquet"))
    types = dict(zip(wide.columns, map(str, wide.types), strict=True))
    assert (types["temperature"], types["opponent"]) == ("DOUBLE", "VARCHAR")
    assert (types["gap_m"], types["joint"], types["driver"]) == ("DOUBLE", "BOOLEAN", "VARCHAR")
    ((humans,),) = wide.filter("source = 'human'").aggregate("count(*)").fetchall()
    crossed = wide.filter("temperature IS NOT NULL").aggregate(
        "driver, temperature, opponent, count(*)"
    )
    assert humans == 33
    assert len(crossed.fetchall()) > 4
    described = rows(exported / "dictionary.csv")
    assert {row["meaning"] != "" for row in described if row["table"] == "trials_wide"} == {True}
    sql = "SELECT trial_id, gap_m FROM trial_metrics ORDER BY ALL"
    trials = query(golden / "golden.duckdb", sql)
    assert wide.select("trial_id, gap_m").order("ALL").fetchall() == trials[1]


def test_a_factor_has_the_type_that_all_its_levels_have():
    factors = cases.table("plans", "factors")
    rows = [[name, level] for name, case in factors.items() for level in case["levels"]]
    with duckdb.connect() as connection:
        connection.execute("CREATE TABLE trial_factors (factor VARCHAR, value VARCHAR)")
        connection.executemany("INSERT INTO trial_factors VALUES (?, ?)", rows)
        found = connection.execute(FACTOR_TYPES.format(only="")).fetchall()
    assert dict(found) == {name: case["kind"] for name, case in factors.items()}


async def test_a_folder_with_anything_else_is_left_as_it_is(merge_runner, golden, tmp_path):
    for name in ("notes.txt", "dictionary.csv", "trials.csv"):
        folder = tmp_path / name.partition(".")[0]
        folder.mkdir()
        (folder / name).write_text("# mine")
        run = await merge_runner("export", folder, "--db", golden / "golden.duckdb", code=2)
        assert "is there and no earlier export: name another folder" in run.err
        assert [path.read_text() for path in folder.iterdir()] == ["# mine"]
    run = await merge_runner("export", "out")
    assert (run.code, "there is no database" in run.err) == (2, True)
    assert not (tmp_path / "out").exists()


def test_every_column_has_a_meaning_and_those_of_a_recording_are_documented():
    for table in tables():
        assert table.comment, table.name
        assert [column.name for column in table.columns if not column.comment] == []
    recording = (PROJECT / "docs/recordings.md").read_text()
    for name, kind in COLUMNS.items():
        assert f"| `{name}` | {kind} | " in recording
