"""The table of first actions: its numbers are those of the stored trials."""

from __future__ import annotations

import json
from dataclasses import replace

import duckdb
import numpy as np
import pytest

from merge_runner.config import ScenarioConfig
from merge_runner.errors import UsageError
from merge_runner.scenarios.merge.conditions import CONDITIONS
from merge_runner_analysis.data.load import load
from merge_runner_analysis.data.study import Study
from merge_runner_analysis.explain import explain
from merge_runner_analysis.explorer.catalogue import Catalogue
from merge_runner_analysis.figures.gallery import figure_of_first_actions
from merge_runner_analysis.tables import make_tables
from tests.support.studies import Drive, write_study

MIRRORED = {
    name: next(
        other
        for other, image in CONDITIONS.items()
        if image
        == replace(
            one,
            projected_headway_m=-one.projected_headway_m,
            relative_velocity_mps=-one.relative_velocity_mps,
        )
    )
    for name, one in CONDITIONS.items()
}
FIRSTS = np.random.default_rng(8).uniform(-0.4, 0.4, (len(CONDITIONS), 4, 2))


def following(driver, slope):
    """A driver whose first action is a slope on the own relative velocity, and some noise."""
    drives = []
    for place, (name, condition) in enumerate(CONDITIONS.items()):
        for rep in range(1, 5):
            own = np.array([1, -1]) * condition.relative_velocity_mps
            left, right = (slope * own + FIRSTS[place, rep - 1]) / 2.5
            actions = ((float(left),) * 3, (float(right),) * 3)
            drives.append(Drive(driver, "baseline", name, rep, *actions))
    return drives


@pytest.fixture(scope="module")
def db(tmp_path_factory):
    path = tmp_path_factory.mktemp("first") / "t.duckdb"
    return write_study(path, [*following("alike", -0.34), *following("blind", 0.0)])


@pytest.fixture(scope="module")
def rows(db):
    return {row.id: row for row in make_tables(Study(db), ["first-action"])[0].rows}


def test_the_human_slope_stands_beside_each_drivers(rows):
    human = rows["human"].values
    assert human["slope"] == -0.338
    assert human["slope_ci"] == pytest.approx((-0.375, -0.301))
    means = ("mean_slower", "mean_equal", "mean_faster")
    assert [human[name] for name in means] == [0.211, -0.013, -0.330]
    assert human["exchange_rate"] == pytest.approx(2.97, abs=5e-3)
    for driver, slope in (("alike", -0.34), ("blind", 0.0)):
        low, high = rows[f"{driver}/baseline"].values["slope_ci"]
        assert low < slope < high


def test_the_numbers_of_a_driver_are_those_of_the_states(db, rows):
    found = load(
        "SELECT acceleration_mps2 AS a, "
        "relative_velocity_mps * if(side = 'left', 1, -1) AS v "
        "FROM states JOIN trials USING (trial_id, spec_hash) "
        "WHERE model_left = 'alike' AND step = 1",
        db,
    )
    values = rows["alike/baseline"].values
    assert values["n"] == len(found) == 88
    for name, there in (
        ("slower", found["v"] < 0),
        ("equal", found["v"] == 0),
        ("faster", found["v"] > 0),
    ):
        assert values[f"mean_{name}"] == pytest.approx(found["a"][there].mean())
    assert values["brake_percent"] == pytest.approx(100 * (found["a"] < -0.2).mean())
    assert values["hold_percent"] == pytest.approx(100 * (found["a"].abs() <= 0.2).mean())
    assert values["go_percent"] == pytest.approx(100 * (found["a"] > 0.2).mean())
    assert values["slope"] == pytest.approx(np.polyfit(found["v"], found["a"], 1)[0])
    assert "exchange_rate" not in values, "there is no word"


def test_a_row_leads_to_its_trials(db):
    study = Study(db)
    (table,) = make_tables(study, ["first-action"])
    (source,) = explain(study, table, "alike/baseline:slope").sources
    assert len(source.trials) == 44
    (human,) = explain(study, table, "human:slope").sources
    assert "initial_action.html" in human.text


def test_drag_counts_as_it_was_realised(tmp_path):
    db = write_study(
        tmp_path / "t.duckdb",
        [Drive("o3", "baseline", name, 1, (0.0,), (0.0,)) for name in CONDITIONS],
        ScenarioConfig(resistance="human"),
    )
    rows = {row.id: row.values for row in make_tables(Study(db), ["first-action"])[0].rows}
    assert rows["o3/baseline"]["mean_equal"] == pytest.approx(-1.0)
    assert rows["o3/baseline"]["brake_percent"] == 100


def test_the_two_drivers_of_a_mixed_pair_have_rows_of_their_own(db, tmp_path):
    mixed = tmp_path / "t.duckdb"
    mixed.write_bytes(db.read_bytes())
    with duckdb.connect(str(mixed)) as connection:
        connection.execute("UPDATE trials SET model_right = 'other' WHERE model_left = 'alike'")
    (table,) = make_tables(Study(mixed), ["first-action"])
    rows = {row.id: row.values for row in table.rows}
    left, right = (rows[f"alike+other/baseline/{side}"] for side in ("left", "right"))
    assert (left["n"], right["n"]) == (44, 44)
    assert left["driver"] == "alike of alike+other"
    assert left["slope"] != right["slope"]


@pytest.mark.slow
def test_a_pair_that_changed_its_sides_is_as_its_ego_saw_it(tmp_path):
    drives = following("alike", -0.34)
    turned = [
        replace(
            drive,
            condition=MIRRORED[drive.condition],
            left=drive.right,
            right=drive.left,
        )
        for drive in drives
    ]
    tables = []
    for name, played, sides in (
        ("one", drives, ("alike", "other")),
        ("other", turned, ("other", "alike")),
    ):
        db = write_study(tmp_path / f"{name}.duckdb", played)
        with duckdb.connect(str(db)) as connection:
            connection.execute("UPDATE trials SET model_left = ?, model_right = ?", sides)
        (table,) = make_tables(Study(db), ["first-action"])
        tables.append(table.rows)
    for one, other in zip(*tables, strict=True):
        assert one.id == other.id
        assert one.values == {
            name: value if isinstance(value, str) else pytest.approx(value)
            for name, value in other.values.items()
        }


def test_a_driver_without_chance_in_a_mixed_pair_counts_once_in_each_situation(tmp_path):
    drives = [replace(drive, right=(0.1,) * 3) for drive in following("alike", -0.34)]
    db = write_study(tmp_path / "t.duckdb", drives)
    with duckdb.connect(str(db)) as connection:
        connection.execute("UPDATE trials SET model_right = 'zero'")
        spec = {"left": {"body": {}}, "right": {"program": "zero"}}
        connection.execute("UPDATE specs SET spec = ?", [json.dumps(spec)])
    (table,) = make_tables(Study(db), ["first-action"])
    rows = {row.id: row.values for row in table.rows}
    assert rows["alike+zero/baseline/left"]["n"] == 44
    assert rows["alike+zero/baseline/right"]["n"] == 11
    assert rows["alike+zero/baseline/right"]["mean_equal"] == pytest.approx(0.25)
    (note,) = {row.note for row in table.rows if "declares no chance" in row.note}
    assert note.startswith("zero of alike+zero declares no chance, and does the same")


@pytest.mark.slow
def test_a_program_of_a_scripted_pair_is_no_stand_in(prepare, tmp_path):
    pair = ("--model", "emulator+projected-order", "--reps", 1)
    assert prepare(tmp_path, "sweep", "baseline", *pair, "--conditions", "N_0_0").code == 0
    (table,) = make_tables(Study(tmp_path / "results/merge.duckdb"), ["first-action"])
    names = {row.values["driver"] for row in table.rows} - {"human"}
    assert names == {
        "emulator of emulator+projected-order*",
        "projected-order of emulator+projected-order",
    }


@pytest.mark.long
def test_who_was_only_asked_has_rows_beside_who_drove_with_the_same_first_actions(
    prepare, tmp_path
):
    pair = ("--model", "emulator+idm", "--mirror", "--conditions", "L_4_8,R_-4_-8,N_0_0")
    for played in (("sweep", "baseline", "--reps"), ("sweep", "baseline", "--first", "--reps")):
        for models in ((), pair):
            run = prepare(tmp_path, *played, 2, *models)
            assert run.code == 0, run.err
    study = Study(tmp_path / "results/merge.duckdb")
    (table,) = make_tables(study, ["first-action"])
    driven = {row.id: row for row in table.rows if row.id != "human"}
    asked = {name: row for name, row in driven.items() if " [asked]/" in name}
    assert len(asked) == len(driven) / 2 == 3
    for name, row in asked.items():
        twin = driven[name.replace(" [asked]", "")]
        assert " [asked]" in row.values["driver"]
        assert row.values | {"driver": twin.values["driver"]} == twin.values
    note = driven["emulator [asked]/baseline"].note
    assert "asked without the loop" in note
    assert "in 22 trials" in note
    (source,) = explain(study, table, "emulator [asked]/baseline:slope").sources
    assert len(source.trials) == len(load(source.query, study.db)) == 22
    assert all(trial.startswith("seat/") for trial in source.trials)
    narrowed = make_tables(Study(study.db, ["emulator"]), ["first-action"])[0].rows
    assert {row.groups[0] for row in narrowed} == {"emulator/baseline", "emulator [asked]/baseline"}
    of_model = Study(study.db, where={"model": ["emulator"]})
    assert [group.id for group in of_model.asked] == ["emulator [asked]/baseline"]


@pytest.fixture(scope="module")
def asked(prepare, tmp_path_factory):
    """The emulator and a program, asked on a grid, and a trial that was driven."""
    folder = tmp_path_factory.mktemp("asked")
    grid = ("--grid", "h=-6:6:2,dv=-1.6:1.6:0.8")
    for ask in (
        ("sweep", "baseline", "--first", "--reps", 4, *grid),
        ("sweep", "baseline", "--first", "--model", "projected-order", "--reps", 2, *grid),
        ("sweep", "baseline", "--reps", 1, "--conditions", "N_0_0"),
    ):
        run = prepare(folder, *ask)
        assert run.code == 0, run.err
    return Study(folder / "results/merge.duckdb")


@pytest.mark.slow
def test_the_planted_exchange_rate_of_who_was_only_asked_is_found_beside_the_humans(asked):
    (table,) = make_tables(asked, ["first-action"])
    rows = {row.id: row.values for row in table.rows}
    own = rows["emulator [asked]/baseline"]
    assert own["n"] == 7 * 5 * 2 * 4
    assert own["exchange_rate_ci"][0] < 3.30 / 1.11 < own["exchange_rate_ci"][1]
    program = rows["projected-order [asked]/baseline"]
    assert program["n"] == 7 * 5 * 2, "each answer counts once"


@pytest.mark.slow
def test_drivers_and_levels_that_were_only_asked_can_be_chosen(asked):
    study = Study(asked.db, ["projected-order"], where={"model": ["projected-order"]})
    assert [group.name for group in study.asked] == ["projected-order [asked]"]
    assert study.models == []
    with pytest.raises(UsageError, match=r"valid: human, emulator, .*projected-order"):
        Study(asked.db, ["idm"])


@pytest.mark.slow
def test_the_explorer_lists_no_situation_and_no_run_that_only_asked(asked):
    catalogue = Catalogue(asked.db)
    catalogue.refresh()
    assert [row["source"] for row in catalogue.ask("SELECT source FROM listed")] == ["llm"]
    (sweep,) = catalogue.ask("SELECT config::VARCHAR AS config FROM sweeps")
    assert not json.loads(sweep["config"])["seat"]


@pytest.mark.slow
def test_the_figure_has_one_panel_with_each_driver_also_one_that_was_only_asked(asked):
    figure = figure_of_first_actions(asked)
    (axis,) = figure.axes
    (legend,) = figure.legends
    names = [text.get_text().split("\n")[0] for text in legend.get_texts()]
    assert names[0] == "humans"
    assert len(names) == len(axis.containers) == 4


@pytest.mark.slow
def test_drivers_that_take_control_one_after_the_other_are_left_out_with_a_note(prepare, tmp_path):
    (tmp_path / "mine.toml").write_text(
        'repetitions = 2\nconditions = ["L_4_8", "R_-4_-8"]\n'
        '[scenario]\ncontrol_start = "own_exit"\n'
    )
    run = prepare(tmp_path, "sweep", "mine.toml")
    assert run.code == 0, run.err
    study = Study(tmp_path / "results/merge.duckdb")
    (table,) = make_tables(study, ["first-action"])
    (row,) = [row for row in table.rows if row.id.startswith("emulator")]
    assert row.values["n"] == 0
    assert '"own_exit" one driver acts while' in row.note
