"""Trials judged again under the other collision rules."""

from __future__ import annotations

import duckdb
import numpy as np
import pandas as pd
import pytest

from analysis.data.collision_rules import (
    BOXES,
    READINGS,
    RULES,
    UNDECIDED,
    Task,
    judged,
    outcomes,
    redrive,
)
from analysis.data.load import load, load_trials
from analysis.data.study import Study
from analysis.tables.robustness import robustness
from merge_runner.config import ScenarioConfig
from merge_runner.records import StateRow, TrialRecord, TrialSpec
from merge_runner.results.store import Store
from merge_runner.scenarios.merge.conditions import CONDITIONS
from merge_runner.scenarios.merge.geometry import TRACK
from tests.analysis.studies import Drive, write_study
from tests.harness import RECORDING

KEY = ["trial_id", "spec_hash"]
OWN_EXIT = """
conditions = ["R_-4_-8", "N_0_0", "L_0_-8"]
repetitions = {baseline = 1}
scenario = {control_start = "own_exit"}
"""
CRUISE = [0.0] * 5  # a decision's actions


def redriven(scenario, condition, applied, last_plans, **looks):
    task = Task(scenario, TRACK)
    return redrive(task, CONDITIONS[condition], applied, last_plans, **looks)


def by_rule(found) -> dict[str, pd.DataFrame]:
    """The outcomes of each rule, in the order of the trials."""
    assert list(found["rule"].unique()) == list(READINGS)
    return {rule: rows.reset_index(drop=True) for rule, rows in found.groupby("rule")}


def same(found, trials) -> bool:
    """Whether trials have these statuses and first mergers."""
    columns = [*KEY, "status", "merged_first"]
    left, right = (frame[columns].fillna("nobody").to_numpy().tolist() for frame in (found, trials))
    return left == right


def driven(condition, left, right, rest=0):
    """Outcomes by rule of plans of single actions; both last plans go on for ``rest`` actions."""
    decided = [[side[k : k + 5] for k in range(0, len(side), 5)] for side in (left, right)]
    last = [[*decisions[-1], *[0.0] * rest] for decisions in decided]
    return {
        rule: redriven(ScenarioConfig(collision_rule=rule), condition, decided, last)
        for rule in RULES
    }


def test_the_rules_are_those_of_the_scenario():
    assert RULES == ("euclid2d", "rectangle", "shared_lane")
    assert (*RULES, "rectangle at 20 Hz") == READINGS


@pytest.mark.slow
def test_a_sweeps_trials_have_their_stored_outcomes_under_their_own_rule(in_process, tmp_path):
    assert in_process("replay", "baseline", "--recording", RECORDING, "--reps", 1) == 0
    db = tmp_path / "results/merge.duckdb"
    trials = load_trials(db)
    assert len(trials) == 11
    found = by_rule(outcomes(db, trials))
    assert same(found["euclid2d"], trials)
    # Where nothing collided the recorded positions tell what a shared lane makes of it.
    pairs = load("SELECT *, greatest(left_m, right_m) AS first_m FROM vehicle_pairs", db)
    close = pairs[(pairs["first_m"] >= 100) & ((pairs["left_m"] - pairs["right_m"]).abs() < 4.5)]
    finished = trials["status"] == "finished"
    assert finished.sum() > 5
    shared = trials["status"].mask(trials["trial_id"].isin(close["trial_id"]), "collided")
    expected = trials.assign(status=shared)
    assert same(found["shared_lane"][finished], expected[finished])


@pytest.mark.slow
def test_constant_drivers_collide_under_every_rule_and_failed_trials_are_left_out(
    in_process, tmp_path
):
    assert in_process("sweep", "baseline", "--model", "constant", "--reps", 1) == 0
    db = tmp_path / "results/merge.duckdb"
    trials = load_trials(db)
    assert set(trials["status"]) == {"collided"}
    for rows in by_rule(outcomes(db, trials)).values():
        assert same(rows, trials)
    failed = trials.assign(status=["failed", *trials["status"][1:]])
    assert set(outcomes(db, failed)["trial_id"]) == set(trials["trial_id"][1:])


@pytest.mark.slow
def test_a_vehicle_that_came_out_later_cruised_before(in_process, tmp_path):
    """Under own_exit the drivers' first decisions lie apart."""
    (tmp_path / "own.toml").write_text(OWN_EXIT)
    assert in_process("sweep", "own.toml", "--model", "projected-order") == 0
    db = tmp_path / "results/merge.duckdb"
    starts = load("SELECT min(time_s) AS first_s FROM decisions GROUP BY trial_id, side", db)
    assert starts["first_s"].max() > 0
    trials = load_trials(db)
    assert same(by_rule(outcomes(db, trials))["euclid2d"], trials)


def test_boxes_may_overlap_where_the_centres_stay_a_vehicle_length_apart():
    """The left gains 0.58 m on its lead of 4 m, and keeps 4.58 m from then on."""
    gain = 0.58 / (2.5 * 0.6**2)
    left = [gain] * 3 + [-gain] * 3 + [0.0] * 44
    assert driven("L_4_0", left, [0.0] * 50) == {
        "euclid2d": ("finished", "left"),
        "rectangle": ("collided", None),
        "shared_lane": ("finished", "left"),
    }
    assert driven("R_-4_0", [0.0] * 50, left)["euclid2d"] == ("finished", "right")
    assert driven("R_-4_0", [0.0] * 50, left)["rectangle"] == ("collided", None)


def test_centres_may_come_close_on_two_branches_where_nothing_touches():
    """Side by side to 76 m, then one brakes and one accelerates as hard as they can."""
    steps = [0.0] * 13
    left, right = [*steps, *[1.0] * 12, *[0.0] * 30], [*steps, *[-1.0] * 12, *[0.0] * 30]
    assert driven("N_0_0", left, right) == {
        "euclid2d": ("collided", None),
        "rectangle": ("finished", "left"),
        "shared_lane": ("finished", "left"),
    }


def test_a_shared_lane_collides_later():
    """Side by side the centres are 4.5 m apart at 82 m, and share a lane from 100 m on."""
    to_89_m, to_97_m, to_101_m = ([0.0] * n for n in (20, 24, 26))
    assert [outcome[0] for outcome in driven("N_0_0", to_89_m, to_89_m).values()] == [
        "collided", UNDECIDED, UNDECIDED
    ]  # fmt: skip
    assert [outcome[0] for outcome in driven("N_0_0", to_97_m, to_97_m).values()] == [
        "collided", "collided", UNDECIDED
    ]  # fmt: skip
    assert [outcome[0] for outcome in driven("N_0_0", to_101_m, to_101_m).values()] == [
        "collided"
    ] * 3


def test_last_plans_go_on_where_they_were_left():
    """Driven to 90 m; the whole plans reach beyond the merge point."""
    driven_out = [0.0] * 20
    assert driven("N_0_0", driven_out, driven_out, rest=3)["shared_lane"] == (UNDECIDED, None)
    assert driven("N_0_0", driven_out, driven_out, rest=5)["shared_lane"] == ("collided", None)


def test_a_last_plan_goes_on_after_the_actions_that_were_driven():
    """Two actions up were driven, two down are left: 0.4 m are won, and 4.4 m are too few.

    From any other action on the left would stay faster, and merge.
    """
    applied = [[CRUISE, [1.0, 1.0]], [CRUISE, [0.0, 0.0]]]
    last = [1.0, 1.0, -1.0, -1.0, *[0.0] * 64]
    scenario = ScenarioConfig(collision_rule="shared_lane")
    assert redriven(scenario, "L_4_0", applied, [last, [0.0] * 68]) == ("collided", None)
    longer = [*[1.0] * 3, *[-1.0] * 3, *[0.0] * 60]  # 0.9 m are enough
    assert redriven(scenario, "L_4_0", applied, [longer, [0.0] * 66]) == ("finished", "left")


def test_it_stays_open_where_one_drivers_plan_is_not_known():
    """A fallback has no plan of its own."""
    applied = [[CRUISE] * 4, [CRUISE] * 4]
    scenario = ScenarioConfig(collision_rule="shared_lane")
    known = [0.0] * 20
    assert redriven(scenario, "N_0_0", applied, [known, known]) == ("collided", None)
    assert redriven(scenario, "N_0_0", applied, [known, []]) == (UNDECIDED, None)
    assert redriven(scenario, "N_0_0", applied, [[], known]) == (UNDECIDED, None)


def test_an_open_trial_has_no_first_merger():
    """The left has passed the merge point, the plans end before the track does."""
    lead = [1.0] * 10 + [0.0] * 20
    found = driven("L_4_0", lead, [-1.0] * 10 + [0.0] * 20)
    assert set(found.values()) == {(UNDECIDED, None)}


def test_a_driver_that_decided_later_cruised_in_the_steps_before():
    """Full throttle from the right's first decision on, five steps late, comes too late to pass."""
    scenario = ScenarioConfig(control_start="own_exit")
    early = redriven(scenario, "N_0_0", [[CRUISE] * 12, [[1.0] * 5] * 12], [[], []])
    late = redriven(scenario, "N_0_0", [[CRUISE] * 12, [[1.0] * 5] * 8], [[], []], begins=(0, 20))
    assert early == ("finished", "right")
    assert late == ("collided", None)
    drawn_out = redriven(
        scenario, "N_0_0", [[[0.0] * 5] * 12, [CRUISE] * 4 + [[1.0] * 5] * 8], [[], []]
    )
    assert late == drawn_out


def test_stored_plans_are_driven_again_under_each_rule(tmp_path):
    """Boxes that overlap alone, plans that lead apart but for one look, and one not known."""
    gain = 0.58 / 2.5  # held for a second each way
    apart = (0.0, 0.0, 0.0, 1.0, 1.0, 1.0, 1.0)
    drives = [
        Drive("o3", "baseline", "L_4_0", 1, (gain, -gain), ()),
        Drive("o3", "baseline", "N_0_0", 2, apart, tuple(-action for action in apart)),
        Drive("o3", "baseline", "N_0_0", 3, (), ()),
        Drive("o3", "baseline", "N_0_0", 4, (), ()),
    ]
    db = write_study(tmp_path / "study.duckdb", drives)
    with duckdb.connect(str(db)) as connection:
        connection.execute(
            "UPDATE decisions SET plan = NULL, fallback = true, valid = false "
            "WHERE trial_id LIKE '%rep04' AND side = 'left' AND decision = 3"
        )
    trials = load_trials(db)
    found = outcomes(db, trials).sort_values("trial_id", key=lambda ids: ids.str[-5:])
    statuses = {rule: list(rows["status"]) for rule, rows in found.groupby("rule")}
    assert statuses == {
        "euclid2d": ["finished", "collided", "collided", "collided"],
        "rectangle": ["collided", UNDECIDED, "collided", UNDECIDED],
        "shared_lane": ["finished", UNDECIDED, "collided", UNDECIDED],
        BOXES: ["collided", "collided", "collided", UNDECIDED],
    }
    firsts = found.dropna(subset=["merged_first"])
    assert set(firsts["rule"]) == {"euclid2d", "shared_lane"}
    assert set(firsts["merged_first"]) == {"left"}


@pytest.mark.parametrize("length_m", [4.5, 7.0])
def test_stored_traces_are_judged_as_their_plans_driven_again(tmp_path, length_m):
    """Trials of any plans, of which many collide; also of longer vehicles."""
    rng = np.random.default_rng(7)
    scenario = ScenarioConfig(vehicle_length_m=length_m)
    drives = [
        Drive("o3", "baseline", str(rng.choice(list(CONDITIONS))), rep,
              *(tuple(rng.uniform(-0.3, 0.3, 12).tolist()) for _ in "lr"))
        for rep in range(100)
    ]  # fmt: skip
    db = write_study(tmp_path / "study.duckdb", drives, scenario)
    trials = load_trials(db)
    assert 20 < (trials["status"] == "collided").sum() < 95
    decided = load(
        "SELECT trial_id, list(applied ORDER BY decision) AS applied, arg_max(plan, decision) "
        "AS last FROM decisions GROUP BY trial_id, side ORDER BY trial_id, side",
        db,
    ).groupby("trial_id")
    found = by_rule(outcomes(db, trials))
    for rule in READINGS:
        own = scenario.model_copy(update={"collision_rule": rule.split(" at ")[0]})
        expected = [
            redriven(own, trial.condition,
                    *(decided.get_group(trial.trial_id)[name].tolist()
                      for name in ("applied", "last")), between=rule == BOXES)
            for trial in trials.itertuples()
        ]  # fmt: skip
        statuses, firsts = zip(*expected, strict=True)
        assert same(found[rule], trials.assign(status=statuses, merged_first=firsts))


@pytest.fixture
def humans(tmp_path):
    """Stores human trials of N_0_0: (status, merged first, positions) each."""

    def store(*trials):
        records = []
        for number, (status, first, pairs) in enumerate(trials):
            spec = TrialSpec(
                f"human/{number}", "h", "human", "human", "human", None, "N_0_0", number, 0, 0,
                pair="pair1",
            )  # fmt: skip
            states = tuple(
                StateRow(step, 0.05 * step, side, position, 10.0, 0.0)
                for step, pair in enumerate(pairs)
                for side, position in zip(("left", "right"), pair, strict=True)
            )
            end_s = 0.05 * (len(pairs) - 1)
            records.append(TrialRecord(spec, status, first, end_s, None, states, ()))
        path = tmp_path / "humans.duckdb"
        Store(path).add_recorded(records, {})
        return path

    return store


def test_human_traces_are_judged_as_they_are(humans):
    apart = [(90.0, 80.0), (110.0, 100.0), (150.0, 140.0)]
    side_by_side = [(84.0, 84.0), (90.0, 80.0), (150.0, 140.0)]
    boxes = [(97.0, 101.55), (101.0, 110.0), (140.0, 150.0)]
    db = humans(
        ("finished", "left", apart),
        ("finished", "left", side_by_side),
        ("collided", None, boxes[:1]),
        ("collided", None, apart[:1]),
        ("timeout", None, apart[:1]),
    )
    found = outcomes(db, load_trials(db))
    assert len(found) == 20
    finished, collided, opened = ("finished", "left"), ("collided", None), (UNDECIDED, None)
    timeout = ("timeout", None)
    expected = {
        "euclid2d": [finished, collided, opened, opened, timeout],
        "rectangle": [finished, finished, collided, opened, timeout],
        "shared_lane": [finished, finished, opened, opened, timeout],
        BOXES: [finished, finished, collided, collided, timeout],
    }
    for rule, rows in by_rule(found).items():
        merged = rows["merged_first"].astype(object).where(rows["merged_first"].notna(), None)
        assert list(zip(rows["status"], merged, strict=True)) == expected[rule]


def test_the_table_says_how_long_the_vehicles_are_that_it_judges(tmp_path):
    drive = Drive("long", "baseline", "L_4_0", 1, (0.8, 0.8), (-0.8, -0.8))
    db = write_study(tmp_path / "long.duckdb", [drive], ScenarioConfig(vehicle_length_m=8.0))
    notes = robustness(Study(db)).notes
    assert "the vehicles are 8 m x 1.8 m" in notes
    assert not any("4.5" in note for note in notes)


def test_humans_are_judged_by_the_drivers_rule_every_fifth_of_a_second(humans):
    """Boxes are what was recorded; a disc is not looked for between the steps of the drivers."""
    apart, close, end = (90.0, 80.0), (84.0, 84.0), (150.0, 140.0)
    db = humans(
        ("finished", "left", [apart] * 4 + [close, apart, end]),
        ("finished", "left", [apart, close, close, close, apart, end]),
        ("collided", None, [apart, close]),
        ("collided", None, [close, apart]),
    )
    trials = judged(db, load_trials(db))
    assert trials["collided_boxes"].tolist() == [False, False, True, True]
    assert trials["collided"].drop(2).tolist() == [True, False, True]
    assert trials["collided"].isna()[2]
