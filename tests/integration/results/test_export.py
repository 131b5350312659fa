"""The exported folder: every table and view, explained, and nothing of anybody else's replaced."""

from __future__ import annotations

import csv

import duckdb
import pytest

from merge_runner.results.export import FACTORS, tables
from merge_runner.results.recording import COLUMNS
from tests.support.harness import PROJECT


def rows(path):
    with path.open(newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


@pytest.mark.slow
async def test_every_table_and_view_is_written_as_parquet_and_csv(merge_runner, tmp_path):
    part = ("sweep", "baseline", "--reps", 1, "--conditions", "N_0_0")
    assert (await merge_runner(*part)).code == 0
    for _ in range(2):  # an earlier export is replaced
        run = await merge_runner("export", "out")
        assert run.code == 0, run.err
        said = "wrote every table into out: begin with out/dictionary.csv\n"
        assert (run.out, run.err) == (said, "")
    folder, db = tmp_path / "out", str(tmp_path / "results/merge.duckdb")
    dictionary = rows(folder / "dictionary.csv")
    with duckdb.connect(db, read_only=True) as connection:
        for table in tables():
            ((there,),) = connection.execute(f"SELECT count(*) FROM {table.name}").fetchall()
            parquet = duckdb.read_parquet(str(folder / f"{table.name}.parquet"))
            assert parquet.shape == (there, len(table.columns))
            assert len(rows(folder / f"{table.name}.csv")) == there
            told = [row["column"] for row in dictionary if row["table"] == table.name]
            assert told == ["", *parquet.columns]
    (gap,) = [
        row for row in dictionary if (row["table"], row["column"]) == ("trial_metrics", "gap_m")
    ]
    assert gap["type"] == "DOUBLE"
    assert gap["meaning"].startswith("net gap, ")


STUDY = """
models = ["constant", "human-odds"]
repetitions = 1
conditions = ["N_0_0", "L_4_0"]
[factors]
memory_s = [1, 2.0]
history_start = ["empty", "cruise"]
"""


@pytest.mark.slow
async def test_the_wide_trials_have_metrics_and_typed_factors_and_humans_stand_beside_them(
    merge_runner, tmp_path
):
    (tmp_path / "study.toml").write_text(STUDY)
    assert (await merge_runner("sweep", "study.toml", "--quiet")).code == 0
    assert (await merge_runner("export", "out")).code == 0
    wide = duckdb.read_parquet(str(tmp_path / "out/trials_wide.parquet"))
    types = dict(zip(wide.columns, map(str, wide.types), strict=True))
    assert (types["memory_s"], types["history_start"]) == ("DOUBLE", "VARCHAR")
    assert (types["gap_m"], types["joint"], types["driver"]) == ("DOUBLE", "BOOLEAN", "VARCHAR")
    counts = wide.aggregate("driver, memory_s, history_start, count(*)").fetchall()
    assert len(counts) == 8
    assert {count for *_, count in counts} == {2}
    assert len(rows(tmp_path / "out/trials_wide.csv")) == 16
    described = rows(tmp_path / "out/dictionary.csv")
    assert {row["meaning"] != "" for row in described if row["table"] == "trials_wide"} == {True}
    with duckdb.connect(str(tmp_path / "results/merge.duckdb"), read_only=True) as connection:
        trials = connection.execute("SELECT trial_id, gap_m FROM trial_metrics ORDER BY ALL")
        assert wide.select("trial_id, gap_m").order("ALL").fetchall() == trials.fetchall()


@pytest.mark.parametrize(
    ("levels", "kind"),
    [
        (["0.2", "1"], "DOUBLE"),
        (["1", "2"], "BIGINT"),
        (["1", "99999999999999999999"], "DOUBLE"),
        (["true", "false"], "BOOLEAN"),
        (["default", "1"], "VARCHAR"),
        (["true", "1"], "VARCHAR"),
    ],
)
def test_a_factor_has_the_type_that_all_its_levels_have(levels, kind):
    with duckdb.connect() as connection:
        connection.execute("CREATE TABLE trial_factors (factor VARCHAR, value VARCHAR)")
        connection.executemany("INSERT INTO trial_factors VALUES ('f', ?)", [[x] for x in levels])
        assert connection.execute(FACTORS.format(only="")).fetchall() == [("f", kind)]


@pytest.mark.slow
async def test_a_folder_with_anything_else_is_left_as_it_is(merge_runner, tmp_path):
    part = ("sweep", "baseline", "--model", "constant", "--reps", 1, "--conditions", "N_0_0")
    assert (await merge_runner(*part)).code == 0
    for name, content in (
        ("notes.txt", "mine"),
        ("dictionary.csv", "# mine"),
        ("trials.csv", "mine"),
    ):
        folder = tmp_path / name.partition(".")[0]
        folder.mkdir()
        (folder / name).write_text(content)
        run = await merge_runner("export", folder)
        assert run.code == 2
        assert "is there and no earlier export: name another folder" in run.err
        assert [path.read_text() for path in folder.iterdir()] == [content]


def test_every_column_of_a_table_and_of_the_metrics_has_a_meaning():
    for table in tables():
        assert table.comment, table.name
        if not table.is_view or table.name == "trial_metrics":
            assert [column.name for column in table.columns if not column.comment] == []


def test_the_documented_columns_are_those_of_the_code():
    described = (PROJECT / "docs/reference/tables.md").read_text()
    (metrics,) = [table for table in tables() if table.name == "trial_metrics"]
    for column in metrics.columns[2:]:
        assert f"| `{column.name}` | {column.comment.replace('|', chr(92) + '|')} |" in described
    recording = (PROJECT / "docs/reference/recordings.md").read_text()
    for name, kind in COLUMNS.items():
        assert f"| `{name}` | {kind} | " in recording


async def test_an_export_of_no_database_writes_nothing(merge_runner, tmp_path):
    run = await merge_runner("export", "out")
    assert run.code == 2
    assert "there is no database" in run.err
    assert list(tmp_path.iterdir()) == []
