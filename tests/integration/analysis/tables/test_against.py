"""Which of the paper's rows a row stands beside, and what is not compared with itself."""

from __future__ import annotations

import duckdb
import pytest

from merge_runner.results.store import Store
from merge_runner.scenarios.merge.conditions import CONDITIONS
from merge_runner_analysis.data.reference_data import published
from merge_runner_analysis.data.study import Study
from merge_runner_analysis.human.archive import open_files
from merge_runner_analysis.human.load import import_trials, sort_files
from merge_runner_analysis.tables import finished_tables, make_tables
from merge_runner_analysis.tables.against import FILES, against
from tests.support.recordings import drive, write_folder
from tests.support.studies import write_study, yielding

TABLE_VII = "ablation-quantitative"


def cell(table, row_id, column):
    (row,) = [row for row in table.rows if row.id == row_id]
    return row.values.get(column)


def paper(driver, setting="baseline", column="gap_m"):
    rows = published("paper_ablation_quantitative").query(
        "driver == @driver and setting == @setting"
    )
    return rows[column].item()


@pytest.fixture(scope="module")
def met(tmp_path_factory):
    """Models, a program, and the emulator under its own name and in gemini's."""
    path = tmp_path_factory.mktemp("met") / "t.duckdb"
    drives = [
        *yielding("o3", reps=1),
        *yielding("o3", "A2", reps=1),
        *yielding("gemini-2.5-pro", reps=1),
        *yielding("emulator", reps=1),
        *yielding("constant", reps=1),
    ]
    write_study(path, drives)
    with duckdb.connect(str(path)) as connection:
        connection.execute(
            "UPDATE trials SET scripted = true WHERE model_left IN ('gemini-2.5-pro', 'emulator')"
        )
    return Study(path)


AT = '{"endpoint": "http://localhost:8080/v1"}'
ELSEWHERE = f"""UPDATE specs SET spec = '{{"left": {AT}, "right": {AT}}}'"""
ANEW = "UPDATE trials SET sample_set = 1"


def changed(folder, sql) -> Study:
    """A study of o3, in which this was otherwise."""
    path = write_study(folder / "t.duckdb", yielding("o3", reps=1))
    with duckdb.connect(str(path)) as connection:
        connection.execute(sql)
    return Study(path)


@pytest.fixture(scope="module")
def partly(tmp_path_factory):
    """Three pairs of humans with one trial in every condition."""
    folder = tmp_path_factory.mktemp("partly")
    files = {
        f"experiment_{pair}/experiment_{pair}_iter_{number}.csv": drive(name).csv()
        for pair in (4, 6, 8)
        for number, name in enumerate(CONDITIONS, 1)
    }
    db = write_study(folder / "t.duckdb", yielding("o3", reps=1))
    with open_files(write_folder(folder / "recordings", files)) as found:
        import_trials(sort_files(found), Store(db))
    return Study(db)


def beside(study, name=TABLE_VII):
    (table,) = make_tables(study, [name])
    return against(table, study)


def differences(table, row_id):
    (row,) = [row for row in table.rows if row.id == row_id]
    return [name for name in row.values if name.endswith("_difference")]


@pytest.mark.slow
def test_published_human_values_stand_there_and_are_not_compared_with_themselves(met):
    tables = [against(table, met) for table in make_tables(met, [*FILES])]
    assert len(tables) == 5
    for table in tables:
        rows = [row for row in table.rows if row.groups[0] == "human"]
        # The published collisions are by boxes: by the other rule there are none to stand beside.
        rows = [row for row in rows if row.id != "human/collided_percent"]
        assert all(any(name.endswith("_in_paper") for name in row.values) for row in rows)
        assert [differences(table, row.id) for row in rows] == [[]] * len(rows)


def test_humans_of_a_partial_import_stand_beside_the_paper_without_differences(partly):
    for name, row in ((TABLE_VII, "human"), ("who-first", "human/intercept")):
        assert differences(beside(partly, name), row) == []
    table = beside(partly, "indicators")
    assert cell(table, "human/collided_boxes_percent", "value_in_paper") == 2.83


def test_a_stand_in_never_stands_beside_the_model_in_whose_name_it_answered(met):
    assert cell(beside(met), "gemini-2.5-pro/baseline", "gap_m_in_paper") is None
    assert cell(beside(met), "o3/baseline", "gap_m_in_paper") == paper("o3")


def test_a_model_at_another_endpoint_does_not_stand_beside_the_papers(tmp_path):
    elsewhere, name = changed(tmp_path, ELSEWHERE), "o3 at localhost:8080/baseline"
    assert cell(beside(elsewhere), name, "gap_m_in_paper") is None


def test_another_sample_set_of_a_driver_stands_beside_the_papers(tmp_path):
    study = changed(tmp_path, ANEW)
    assert cell(beside(study), "o3/set1/baseline", "gap_m_in_paper") == paper("o3")


def test_a_kept_table_stands_beside_the_paper_as_one_just_made(met):
    made = beside(met)
    for _ in range(2):
        (kept,) = (against(t, met) for t in finished_tables(met.db, [TABLE_VII]))
        assert [row.values for row in kept.rows] == [row.values for row in made.rows]


def test_values_stand_against_the_paper_alone(met, in_process, capsys):
    assert in_process("tables", TABLE_VII, "--db", met.db, "--against", "humans") == 2
    assert "valid is paper" in capsys.readouterr().err
    assert in_process("tables", TABLE_VII, "--db", met.db, "--against", "paper") == 0
    assert "paper: " in capsys.readouterr().out
