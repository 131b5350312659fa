"""Whether trials collided, by the rule of their scenario and by that of the human experiment."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest

from merge_runner.config import ScenarioConfig
from merge_runner.records import StateRow, TrialRecord, TrialSpec
from merge_runner.results.store import Store
from merge_runner.scenarios.merge.conditions import CONDITIONS
from merge_runner_analysis.data.collision_rules import judged
from merge_runner_analysis.data.load import load_trials
from tests.analysis.studies import Drive, write_study


@pytest.fixture
def chance_drives():
    """Trials of accelerations by chance, of which many collide."""
    chance = np.random.default_rng(7)
    names = [*CONDITIONS]
    return [
        Drive("o3", "baseline", str(chance.choice(names)), rep, *chance.uniform(-0.3, 0.3, (2, 12)))
        for rep in range(100)
    ]


def judged_by(path, drives, **scenario):
    """The trials as driven under such a scenario, by repetition."""
    db = write_study(path, drives, ScenarioConfig(**scenario))
    return judged(db, load_trials(db)).set_index("rep").sort_index()


@pytest.mark.slow
@pytest.mark.parametrize("length_m", [4.5, 7.0])
def test_boxes_are_those_of_the_humans_rule_up_to_where_another_ended_the_trial(
    tmp_path, chance_drives, length_m
):
    fine = {"step_s": 0.05, "vehicle_length_m": length_m}
    truth = judged_by(tmp_path / "a", chance_drives, **fine, collision_rule="rectangle")
    cut_off = judged_by(tmp_path / "b", chance_drives, **fine)
    assert truth["collided_boxes"].equals(truth["collided"])
    undecided = cut_off["collided_boxes"].isna()
    assert 0 < undecided.sum() < 100
    assert cut_off["collided"][undecided].all()
    pd.testing.assert_series_equal(
        cut_off["collided_boxes"][~undecided], truth["collided_boxes"][~undecided]
    )


@pytest.mark.slow
def test_what_is_seen_between_steps_is_what_a_finer_simulation_sees(tmp_path, chance_drives):
    """Four steps of 0.05 s with one action are one of 0.2 s."""
    rule = {"collision_rule": "rectangle"}
    finer = [
        replace(one, left=np.repeat(one.left, 4), right=np.repeat(one.right, 4))
        for one in chance_drives
    ]
    coarse = judged_by(tmp_path / "a", chance_drives, **rule)
    fine = judged_by(tmp_path / "b", finer, **rule, step_s=0.05)
    assert coarse["collided_boxes"].equals(fine["collided"])
    assert 0 < fine["collided"].sum() < 100


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
