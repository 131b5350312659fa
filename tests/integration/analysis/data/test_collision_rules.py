"""Whether trials collided, by the rule of their scenario and by that of the human experiment."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest

from merge_runner.config import ScenarioConfig
from merge_runner.scenarios.merge.conditions import CONDITIONS
from merge_runner_analysis.data.load import load_trials
from merge_runner_analysis.data.trials import judged
from tests.support.studies import Drive, write_study


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
