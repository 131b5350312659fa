"""The table of first actions: its numbers are those of the stored trials."""

import json
from dataclasses import replace

import numpy as np
import pytest

from merge_runner.config import ScenarioConfig
from merge_runner.errors import UsageError
from merge_runner.scenarios.merge.conditions import CONDITIONS
from merge_runner_analysis.explain import explain
from merge_runner_analysis.figures.first_action import first_action
from merge_runner_analysis.frames import load
from merge_runner_analysis.selection import Selection
from merge_runner_analysis.study import StudyResults
from merge_runner_analysis.web.trial_index import TrialIndex
from tests.support.studies import Drive, changed, write_study
from tests.support.tables import by_id, made, values_of

BY_PLACE = {(c.projected_headway_m, c.relative_velocity_mps): n for n, c in CONDITIONS.items()}
MIRRORED = {name: BY_PLACE[-h, -dv] for (h, dv), name in BY_PLACE.items()}
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
    return values_of(StudyResults(db), "first-action")


def test_the_human_slope_stands_beside_each_drivers(rows):
    human = rows["human"]
    names = ("slope", "mean_slower", "mean_equal", "mean_faster")
    assert [human[name] for name in names] == [-0.338, 0.211, -0.013, -0.330]
    assert human["slope_ci"] == pytest.approx((-0.375, -0.301))
    assert human["exchange_rate"] == pytest.approx(2.97, abs=5e-3)
    for driver, slope in (("alike", -0.34), ("blind", 0.0)):
        low, high = rows[f"{driver}/baseline"]["slope_ci"]
        assert low < slope < high


def test_the_numbers_of_a_driver_are_those_of_the_states(db, rows):
    found = load(
        "SELECT acceleration_mps2 AS a, "
        "relative_velocity_mps * if(side = 'left', 1, -1) AS v "
        "FROM states JOIN trials USING (trial_id, spec_hash) "
        "WHERE model_left = 'alike' AND step = 1",
        db,
    )
    values, a, v = rows["alike/baseline"], found["a"], found["v"]
    assert values["n"] == len(found) == 88
    expected = {
        "mean_slower": a[v < 0].mean(), "mean_equal": a[v == 0].mean(),
        "mean_faster": a[v > 0].mean(), "slope": np.polyfit(v, a, 1)[0],
        "brake_percent": 100 * (a < -0.2).mean(), "hold_percent": 100 * (a.abs() <= 0.2).mean(),
        "go_percent": 100 * (a > 0.2).mean(),
    }  # fmt: skip
    assert {name: values[name] for name in expected} == pytest.approx(expected)
    assert "exchange_rate" not in values, "there is no word"


def test_drag_counts_as_it_was_realised(tmp_path):
    drives = [Drive("o3", "baseline", name, 1, (0.0,), (0.0,)) for name in CONDITIONS]
    db = write_study(tmp_path / "t.duckdb", drives, ScenarioConfig(resistance="human"))
    row = values_of(StudyResults(db), "first-action")["o3/baseline"]
    assert row["mean_equal"] == pytest.approx(-1.0)
    assert row["brake_percent"] == 100


def test_the_two_drivers_of_a_mixed_pair_have_rows_as_its_ego_saw_them(tmp_path):
    drives = following("alike", -0.34)
    turned = [
        replace(d, condition=MIRRORED[d.condition], left=d.right, right=d.left) for d in drives
    ]
    one, other = (
        values_of(
            changed(
                write_study(tmp_path / f"{left}.duckdb", played),
                f"UPDATE trials SET model_left = '{left}', model_right = '{right}'",
            ),
            "first-action",
        )
        for played, left, right in ((drives, "alike", "other"), (turned, "other", "alike"))
    )
    left, right = (one[f"alike+other/baseline/{side}"] for side in ("left", "right"))
    assert (left["n"], right["n"]) == (44, 44)
    assert left["driver"] == "alike of alike+other"
    assert left["slope"] != right["slope"]
    for name, values in one.items():
        numbers = {k: v for k, v in values.items() if not isinstance(v, str)}
        assert numbers == {k: pytest.approx(other[name][k]) for k in numbers}, name
        assert values["driver"] == other[name]["driver"]


def test_a_driver_without_chance_in_a_mixed_pair_counts_once_in_each_situation(tmp_path):
    drives = [replace(drive, right=(0.1,) * 3) for drive in following("alike", -0.34)]
    spec = json.dumps({"left": {"body": {}}, "right": {"program": "zero"}})
    study = changed(
        write_study(tmp_path / "t.duckdb", drives),
        "UPDATE trials SET model_right = 'zero'",
        f"UPDATE specs SET spec = '{spec}'",
    )
    rows = by_id(made(study, "first-action"))
    left, right = (rows[f"alike+zero/baseline/{side}"] for side in ("left", "right"))
    assert (left.values["n"], right.values["n"]) == (44, 11)
    assert right.values["mean_equal"] == pytest.approx(0.25)
    (note,) = {row.note for row in rows.values() if "deterministic" in row.note}
    assert note.startswith("zero of alike+zero is deterministic, and its first action")


# Who was only asked

FEW = """
models = ["emulator", "emulator+projected-order"]
repetitions = 1
mirror = true
conditions = ["L_4_8", "R_-4_-8", "N_0_0"]
"""


@pytest.fixture(scope="module")
def asked(prepare, tmp_path_factory):
    """The emulator, a program and a pair, driven and asked alone; and asked on a grid."""
    folder = tmp_path_factory.mktemp("asked")
    (folder / "few.toml").write_text(FEW)
    (folder / "grid.toml").write_text('models = ["emulator", "projected-order"]\nrepetitions = 2')
    grid = ("--grid", "h=-6:6:2,dv=-1.6:1.6:0.8", "--db", "grid.duckdb")
    for ask in (
        ("few.toml", "--db", "t.duckdb"),
        ("few.toml", "--first", "--db", "t.duckdb"),
        ("grid.toml", "--first", *grid),
    ):
        prepare(folder, "sweep", *ask, code=0)
    return folder


def test_a_share_of_first_actions_leads_to_the_trials_that_have_them(db):
    study = StudyResults(db)
    table = made(study, "first-action")
    first = "SELECT trial_id, side, arg_min(acceleration_mps2, step) AS a FROM states "
    first += "WHERE time_s > 0 AND trial_id LIKE 'alike/%' GROUP BY ALL"
    for kind, rule in {"brake": "a < -0.2", "hold": "abs(a) <= 0.2", "go": "a > 0.2"}.items():
        (source,) = explain(study, table, f"alike/baseline:{kind}_percent").sources
        known = load(f"SELECT trial_id FROM ({first}) WHERE {rule}", db)["trial_id"]
        assert {*source.numerator} == {*known} == {*load(source.query, db)["trial_id"]}
        assert f"the value counts {len(known)} of them, in {known.nunique()} trials" in source.text
    (human,) = explain(study, table, "human:brake_percent").sources
    assert "published" in human.text


def test_who_was_only_asked_has_rows_beside_who_drove_with_the_same_first_actions(asked):
    study = StudyResults(asked / "t.duckdb")
    table = made(study, "first-action")
    rows = by_id(table)
    alone = {name: row for name, row in rows.items() if " [asked]/" in name}
    assert len(alone) == (len(rows) - 1) / 2 == 3
    for name, row in alone.items():
        twin = rows[name.replace(" [asked]", "")]
        assert " [asked]" in row.values["driver"]
        assert row.values | {"driver": twin.values["driver"]} == twin.values
    # A program of a scripted pair is no mock model.
    assert {row.values["driver"] for row in rows.values()} >= {
        "emulator of emulator+projected-order*", "projected-order of emulator+projected-order",
    }  # fmt: skip
    note = rows["emulator [asked]/baseline"].note
    assert "asked without the loop" in note
    assert "in 3 trials" in note
    (source,) = explain(study, table, "emulator [asked]/baseline:slope").sources
    assert len(source.trials) == len(load(source.query, study.db)) == 3
    assert all(trial.startswith("seat/") for trial in source.trials)


def test_drivers_and_levels_that_were_only_asked_can_be_chosen(asked):
    db = asked / "t.duckdb"
    narrowed = made(StudyResults(db, Selection(["emulator"])), "first-action").rows
    assert {row.groups[0] for row in narrowed} == {"emulator/baseline", "emulator [asked]/baseline"}
    of_model = StudyResults(asked / "grid.duckdb", Selection(where={"model": ["projected-order"]}))
    assert [group.name for group in of_model.probes] == ["projected-order [asked]"]
    assert of_model.models == []
    with pytest.raises(UsageError, match=r"valid: human, emulator, .*projected-order"):
        StudyResults(db, Selection(["idm"]))


def test_the_planted_exchange_rate_of_who_was_only_asked_is_found_beside_the_humans(asked):
    rows = values_of(StudyResults(asked / "grid.duckdb"), "first-action")
    own, program = (rows[f"{name} [asked]/baseline"] for name in ("emulator", "projected-order"))
    assert own["n"] == 7 * 5 * 2 * 2
    assert own["exchange_rate_ci"][0] < 3.30 / 1.11 < own["exchange_rate_ci"][1]
    assert program["n"] == 7 * 5 * 2, "each answer counts once"


def test_the_explorer_and_the_figure_tell_who_was_only_asked(asked):
    trial_index = TrialIndex(asked / "t.duckdb")
    trial_index.refresh()
    listed = trial_index.ask("SELECT DISTINCT source FROM listed")
    assert [row["source"] for row in listed] == ["llm"]
    configs = trial_index.ask("SELECT config::VARCHAR AS config FROM sweeps")
    assert [bool(json.loads(sweep["config"])["seat"]) for sweep in configs] == [False]
    figure = first_action(StudyResults(asked / "t.duckdb"))
    (axis,), (legend,) = figure.axes, figure.legends
    names = [text.get_text() for text in legend.get_texts()]
    assert len(names) == sum(line.get_markerfacecolor() == "white" for line in axis.lines)
    assert any("[asked]" in name for name in names)


def test_drivers_that_take_control_one_after_the_other_are_left_out_with_a_note(tmp_path):
    apart = ScenarioConfig(control_start="own_exit")
    db = write_study(tmp_path / "t.duckdb", following("alike", -0.34)[:8], apart)
    row = by_id(made(StudyResults(db), "first-action"))["alike/baseline"]
    assert row.values["n"] == 0
    assert '"own_exit" one driver acts while' in row.note
