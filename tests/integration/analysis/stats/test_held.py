"""I5 of stored trials: whether accelerations are held; of programs known to hold and to move."""

from dataclasses import replace

import pytest
from scipy import stats

from merge_runner.config import ScenarioConfig
from merge_runner_analysis.facts import Fact, Why
from merge_runner_analysis.frames import SPEEDS, load
from merge_runner_analysis.stats.held import measure_profiles
from merge_runner_analysis.stats.indicators import (
    Judgement,
    gains,
    mean_gain,
    piecewise_constant,
    profiles,
    score,
)
from merge_runner_analysis.study import StudyResults
from tests.support.studies import SCENARIO, changed, write_study, yielding
from tests.support.tables import by_id, made

# A trial that starts when the first of the two is under control, and a drag to drive against.
DRAG = """
models = ["constant+projected-order"]
repetitions = 1
conditions = ["L_4_-8", "R_-4_8"]
[scenario]
resistance = "human"
control_start = "own_exit"
"""


def driving(tmp_path, right=(), scenario=SCENARIO) -> StudyResults:
    """One trial in each condition in which the left vehicle slows for 3 s, the right as told."""
    drives = [replace(d, left=(-0.9, -0.6, -0.3), right=right) for d in yielding("o3", reps=1)]
    return StudyResults(write_study(tmp_path / "t.duckdb", drives, scenario))


def test_a_trial_has_the_mean_gain_of_the_vehicles_that_acted(tmp_path):
    study = driving(tmp_path)
    (group,) = study.models
    vehicles = profiles(study, group).set_index(["side", "trial_id"])
    found = gains(study, group).set_index("trial_id")
    assert len(found) == 11
    assert vehicles.loc["right", "steady"].all()
    assert not found["steady"].any()
    assert found["gain"].to_dict() == vehicles.loc["left", "gain"].to_dict()


def test_a_model_that_drives_against_the_resistance_is_measured_as_without(tmp_path):
    """Its pedal is held: so are its accelerations, though its speed is nowhere a straight line."""
    study = driving(tmp_path, (0.4, 0.2, 0.0), ScenarioConfig(resistance="human"))
    slowed = load(SPEEDS, study.db)
    assert slowed["resisted"].all()
    with_it = measure_profiles(slowed.assign(resisted=False))["gain"]
    found = profiles(study, study.models[0])["gain"]
    assert (found > with_it).mean() > 0.9
    assert (found > 0).all()


def test_a_trial_without_action_neither_passes_nor_fails_and_is_told(tmp_path):
    stop = "UPDATE states SET velocity_mps = 10 WHERE trial_id LIKE '%L_4%'"
    study = changed(driving(tmp_path).db, stop)
    (group,) = study.models
    still = gains(study, group).query("steady")
    assert list(still["condition"].sort_values()) == ["L_4_-8", "L_4_0", "L_4_8"]
    assert mean_gain(study, group).n == 8
    row = by_id(made(study, "indicators"))["o3/baseline/I5"]
    assert "I5 without 3 of 11 trials: no control action" in row.note
    assert (row.values["paper"], row.values["robust"]) == (None, True)
    assert row.values["value"] == mean_gain(study, group).value
    never = changed(study.db, "UPDATE states SET velocity_mps = 10")
    row = by_id(made(never, "indicators"))["o3/baseline/I5"]
    assert "no finished trial with control action" in row.note


@pytest.fixture(scope="module")
def programs(golden):
    study = StudyResults(golden / "golden.duckdb")
    return study, {group.driver: group for group in study.models}


def test_idm_moves_and_its_gap_depends_on_who_is_faster_and_projected_order_holds(programs):
    study, groups = programs
    idm = score(study, groups["idm"])
    assert (idm.paper["I4"], idm.robust["I4"]) == (Judgement(True), Judgement(False))
    assert (idm.paper["I5"], idm.robust["I5"]) == (Judgement(None), Judgement(False))
    assert score(study, groups["projected-order"]).robust["I5"] == Judgement(True)


def test_before_an_import_humans_are_judged_by_eye_and_a_driver_by_its_accelerations(small):
    human, driver = score(small, small.human), score(small, small.models[0])
    eye = Fact(Why.BY_EYE)
    assert (human.paper["I5"], human.robust["I5"]) == (Judgement(True, eye), Judgement(None, eye))
    assert (driver.paper["I5"], driver.robust["I5"]) == (Judgement(None), Judgement(True))


def test_i5_is_one_sided_the_mean_gain_is_above_0(programs):
    study, groups = programs
    seen = set()
    for name in ("idm", "quantal", "projected-order"):
        names = groups[name].finished["trial_id"].tolist()
        for start in range(0, len(names) - 3, 3):
            part = groups[name].part(
                lambda t, few=names[start : start + 3]: t["trial_id"].isin(few)
            )
            values = gains(study, part)["gain"]
            above = stats.ttest_1samp(values, 0, alternative="greater").pvalue < 0.025
            assert piecewise_constant(study, part) == Judgement(above)
            seen.add((above, values.mean() > 0))
    assert {(True, True), (False, False)} <= seen


def test_neither_drag_nor_the_cruise_before_control_passes_for_an_action(prepare, tmp_path):
    (tmp_path / "drag.toml").write_text(DRAG)
    prepare(tmp_path, "sweep", "drag.toml", "--db", "t.db", code=0)
    study = StudyResults(tmp_path / "t.db")
    (group,) = study.models
    vehicles = profiles(study, group)
    constant = vehicles[vehicles["side"] == "left"]
    assert constant["steady"].all()
    assert constant["gain"].isna().all()
    assert not gains(study, group)["steady"].any()
