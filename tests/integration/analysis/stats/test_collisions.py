"""Collisions of models by the rule of centres and by that of the humans, side by side."""

import re
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest

from merge_runner.config import ScenarioConfig
from merge_runner.scenarios.merge.conditions import CONDITIONS
from merge_runner_analysis.frames import read_frames
from merge_runner_analysis.metrics import BOXES, COLLISIONS
from merge_runner_analysis.published import human_counts
from merge_runner_analysis.stats.measures import counts
from merge_runner_analysis.stats.score_interval import wilson
from merge_runner_analysis.study import StudyResults
from merge_runner_analysis.tables import make_tables
from tests.support.serving import Page, client_of
from tests.support.studies import Drive, changed, write_study

# So strong vehicles reach the end of the track within one plan.
STRONG = ScenarioConfig(max_acceleration_mps2=5.0)
SIDE_BY_SIDE = (0.0, 0.0, 0.0)
UP, DOWN = (1.0,) * 4, (-1.0,) * 4
HAND_MADE = [
    # The centres come within 4.5 m on the two branches, then one vehicle stops.
    Drive("o3", "baseline", "N_0_0", 1, (*SIDE_BY_SIDE, *UP), (*SIDE_BY_SIDE, *DOWN)),
    # 4.6 m ahead on the merge: boxes touch at its angle for less than a step.
    Drive("o3", "baseline", "L_4_0", 2, (0.0, 0.0, 0.0, 0.16), ()),
    # The same closeness of the centres, but the plans end before anybody has finished.
    Drive("o3", "baseline", "N_0_0", 3, (*SIDE_BY_SIDE, 0.5, 0.5), (*SIDE_BY_SIDE, *DOWN)),
    # Side by side to the end.
    Drive("o3", "baseline", "N_0_0", 4, (), ()),
    Drive("o3", "baseline", "L_4_0", 5, (0.5, 0.5), ()),
]


@pytest.fixture(scope="module")
def study(tmp_path_factory):
    path = tmp_path_factory.mktemp("collisions") / "study.duckdb"
    return StudyResults(write_study(path, HAND_MADE, STRONG))


def test_each_trial_is_judged_by_both_rules(study):
    (group,) = study.models
    trials = group.trials.set_index("rep")
    assert trials["collided"].to_dict() == {1: True, 2: False, 3: True, 4: True, 5: False}
    boxes = trials["collided_boxes"]
    assert boxes.drop([1, 3, 4]).to_dict() == {2: True, 5: False}
    assert boxes[[1, 3, 4]].isna().all()
    assert counts(group, COLLISIONS) == (3, 5)
    assert counts(group, BOXES) == (1, 2)


def test_a_trial_s_page_says_how_both_rules_can_disagree_and_a_link_lists_what_one_counts(study):
    with client_of(study.db) as client:
        pages = [
            Page(client.get(f"/trials/o3/baseline/{name}").text).text
            for name in ("N_0_0/rep01", "L_4_0/rep02", "L_4_0/rep05")
        ]
        disagree = (
            "By people's rule it crashed at 4.1 s: the outlines overlapped, with the centres "
            "4.76 m apart. By the rule of centres, which was played, it did not: a crash is when "
            "the vehicles' centres are closer than a vehicle length (4.5 m), checked every 0.2 s. "
            "Vehicles at an angle touch with a corner while their centres are still a length apart."
        )
        unknown = "Not known by people's rule: the outlines had not overlapped when the trial ended"
        assert [unknown in page for page in pages] == [True, False, False]
        assert [disagree in page for page in pages] == [False, True, False]
        assert not re.search("people's rule", pages[2])
        (to,) = [to for to, _ in Page(client.get("/").text).to("/trials") if "%3Ak" in to]
        of_link = Page(client.get(to).text)
        assert "o3, Baseline, crashes: trials that crashed by people's rule = 1." in of_link.text
        assert [text for _, text in of_link.to("/trials/o3/")] == ["L_4_0 · 02"]


def test_a_trial_that_failed_has_not_collided_by_any_rule(tmp_path):
    """Its boxes had overlapped before the call that was not answered."""
    path = write_study(tmp_path / "failed.duckdb", HAND_MADE, STRONG)
    study = changed(path, "UPDATE trials SET status = 'failed' WHERE rep = 2")
    trials = study.models[0].trials.set_index("rep")
    assert trials.loc[2, ["collided", "collided_boxes"]].isna().all()


def test_both_rates_stand_in_the_tables_with_what_is_left_out(study):
    quantitative, indicators = make_tables(study, ["ablation-quantitative", "indicators"])
    row = next(row for row in quantitative.rows if row.id == "o3/baseline")
    assert row.values["collided_percent"] == 60
    assert row.values["collided_boxes_percent"] is None
    worst_cases = 100 * wilson(1 / 5, 5)[0], 100 * wilson(4 / 5, 5)[1]
    assert row.values["collided_boxes_percent_ci"] == pytest.approx(worst_cases)
    for table, row_id in (
        (quantitative, "o3/baseline"),
        (indicators, "o3/baseline/collided_boxes_percent"),
    ):
        note = next(row.note for row in table.rows if row.id == row_id)
        assert "by people's rule 1 to 4 of 5 trials crashed: in 1 the outlines overlap" in note
        assert any("outlines that overlap, checked at 20 Hz" in note for note in table.notes)
    by_disc = next(r for r in indicators.rows if r.id == "o3/baseline/collided_percent")
    assert by_disc.note == ""


def test_a_driver_is_compared_with_humans_by_the_rule_of_the_humans(study, tmp_path):
    by_boxes = STRONG.model_copy(update={"collision_rule": "rectangle"})
    played = StudyResults(write_study(tmp_path / "boxes.duckdb", HAND_MADE, by_boxes))
    (table,) = make_tables(played, ["verdicts"])
    found = next(row.values for row in table.rows if row.id == "o3/baseline/collisions")
    assert (found["k"], found["n"], found["undecided"]) == (2, 5, None)
    # In the conditions that it drove, as often as it drove them.
    rates = [human_counts()[name] for name in played.models[0].trials["condition"]]
    assert found["human"] == pytest.approx(100 * sum(of.collided / sum(of) for of in rates) / 5)


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
    return read_frames(db).trials.set_index("rep").sort_index()


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
