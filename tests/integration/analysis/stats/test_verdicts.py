"""Drivers beside the humans: one model behind estimate, interval and p, and sentences of states."""

from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from merge_runner.config import ScenarioConfig
from merge_runner_analysis.published import human_counts
from merge_runner_analysis.stats.human_reference import human_fit, human_gap
from merge_runner_analysis.stats.verdicts import compared
from merge_runner_analysis.study import StudyResults
from merge_runner_analysis.wording import DIFFERS, MEASURES
from tests.support.studies import Drive, write_study, yielding
from tests.support.tables import by_id, made, notes_with, values_of

BOXES = ScenarioConfig(collision_rule="rectangle")


@pytest.fixture(scope="module")
def study(tmp_path_factory):
    """A driver like the humans, and one that crashes where nobody is ahead."""
    crashes = [
        Drive("wild", "baseline", name, rep, (0.1 * rep,) * 9, (0.1 * rep,) * 9)
        for name in ("N_0_0", "L_4_0", "R_-4_0")
        for rep in range(1, 7)
    ]
    drives = [*yielding("o3", reps=5), *yielding("wild", reps=2), *crashes]
    drives = {(one.driver, one.condition, one.rep): one for one in drives}
    path = tmp_path_factory.mktemp("verdicts") / "t.duckdb"
    return StudyResults(write_study(path, drives.values(), BOXES))


@pytest.fixture(scope="module")
def table(study):
    return made(study, "verdicts")


@pytest.fixture(scope="module")
def rows(table):
    return {name: row.values for name, row in by_id(table).items()}


def test_few_collisions_are_tested_exactly_as_by_fisher(tmp_path):
    collided, n = 2, 9
    apart, together = ((0.4,) * 9, (-0.4,) * 9), ((0.1,) * 9, (0.1,) * 9)
    drives = [
        Drive("o3", "baseline", "N_0_0", rep, *(together if rep <= collided else apart))
        for rep in range(1, n + 1)
    ]
    study = StudyResults(write_study(tmp_path / "t.duckdb", drives, BOXES))
    found = values_of(study, "verdicts")["o3/baseline/collisions"]
    humans = human_counts()["N_0_0"]
    table = [[collided, n - collided], [humans.collided, sum(humans) - humans.collided]]
    assert found["p"] == pytest.approx(stats.fisher_exact(table).pvalue)
    assert (found["k"], found["n"]) == (collided, n)
    assert found["detectable"] is None  # so few trials have no verdict
    low, high = found["difference_ci"]
    assert (found["p_holm"] < 0.05) == (not low <= 0 <= high)


def test_the_interval_beside_a_verdict_agrees_with_its_corrected_p_and_names_its_level(rows):
    tested = {name: row for name, row in rows.items() if row.get("p_holm") is not None}
    assert len(tested) == 10
    for name, values in tested.items():
        assert 90 <= values["level"] < 100
        assert values["p"] <= values["p_holm"]
        differs_by_p = values["p_holm"] < 0.05
        assert (values["state"] in DIFFERS) == differs_by_p, name
        margin = MEASURES[values["measure"]].margin
        if margin is not None:
            assert (values["ci"][0] > margin) == differs_by_p
            continue
        low, high = values["difference_ci"]
        assert differs_by_p == (not low <= 0 <= high), name
        assert values["difference"] == pytest.approx(values["estimate"] - values["human"])


@pytest.mark.parametrize(
    ("gap_of", "scatter", "state", "level"),
    [
        # The signed product alone: none where nobody is ahead, 2.2 m where one is by 4.
        (lambda h, dv: 17 + 0.34 * h * dv, 0.02, "unlike", None),
        (lambda h, dv: 4 + 0.03 * h * dv, 0.02, "shown", 0.9),
        (lambda h, dv: 4 + 0.15 * h * dv, 2.0, "inconclusive", None),
    ],
)
def test_i4_is_judged_by_the_largest_predicted_difference(study, gap_of, scatter, state, level):
    group = study.models[0]
    headway, velocity = group.trials[["projected_headway_m", "relative_velocity_mps"]].to_numpy().T
    noise = np.random.default_rng(1).standard_normal(len(headway))
    gap = gap_of(headway, velocity) + scatter * noise
    moved = replace(group, trials=group.trials.assign(gap_m=gap, counted_gap_m=gap))
    (found,) = (c for c in compared(study, moved) if c.measure.name == "gap-velocity")
    low, high = found.driver.bounds()
    assert found.state == state
    assert level is None or found.tested.level == pytest.approx(level)
    assert found.human.value == pytest.approx(6.4 * 0.06)
    if state == "unlike":
        assert found.driver.value == pytest.approx(0.34 * 6.4, abs=0.05)
        assert found.tested.level >= 0.95
    assert {"unlike": low > 1, "shown": high < 1, "inconclusive": low <= 1 <= high}[state]


def test_humans_leave_their_gap_in_the_conditions_of_the_drivers_finished_trials(study):
    """Beside a driver that finished in wide conditions alone, they leave more."""
    group, human = study.models[0], study.human
    assert human_gap(human, human).value == pytest.approx(3.85)
    narrow = group.trials["projected_headway_m"].abs() != 4
    wide = human_gap(human, group.part(lambda trials: ~narrow))
    regression = 3.54 + 0.17 * 4 - 0.2 * 0.8 * 2 / 3  # h dv cancels
    assert wide.value == pytest.approx(regression, abs=0.05)
    assert wide.value > human_gap(human, group).value
    # Conditions in which no trial has a gap do not count.
    lost = group.trials.assign(
        status=group.trials["status"].mask(narrow, "collided"),
        counted_gap_m=group.trials["counted_gap_m"].mask(narrow),
    )
    assert human_gap(human, replace(group, trials=lost)) == wide


def test_the_humans_are_the_published_ones(study, rows):
    assert rows["human/gap"]["ci"] == pytest.approx((2.88, 4.82), abs=0.005)
    # The published errors of the gap follow from the outcomes and one deviation.
    fit = human_fit(study.human)
    errors = [term.se for term in fit.terms.values()]
    assert np.sqrt(np.diag(fit.covariance)) == pytest.approx(errors, rel=0.02)


def test_with_undecided_trials_there_is_no_p_and_n_is_that_of_the_decided_ones(tmp_path):
    drives = [
        Drive("o3", "baseline", name, rep, (0.1 * rep,) * 9, (0.1 * rep,) * 9)
        for name in ("N_0_0", "L_4_0")
        for rep in range(1, 4)
    ]
    study = StudyResults(write_study(tmp_path / "t.duckdb", drives))
    table = made(study, "verdicts")
    row = by_id(table)["o3/baseline/collisions"]
    beside = values_of(study, "indicators")["o3/baseline/collided_boxes_percent"]
    assert (row.values["undecided"], row.values["n"], beside["n"]) == (4, 2, 2)
    assert "of 6 trials crashed" in row.note
    untested = ("estimate", "difference", "difference_ci", "level", "p", "p_holm", "detectable")
    assert {row.values[name] for name in untested} == {None}
    assert row.values["state"] == "inconclusive"
    assert notes_with(table, "by the rule of centres, in 2 to 6 by people's rule")


def test_a_replayed_human_is_not_judged(tmp_path):
    asked = {"program": "human-replay", "data": "a hash"}
    drives = yielding("human-replay", reps=1)
    table = made(StudyResults(write_study(tmp_path / "t.duckdb", drives, asked=asked)), "verdicts")
    assert {row.groups for row in table.rows} == {("human",)}
    assert notes_with(table, "both humans are replayed and do not react")
