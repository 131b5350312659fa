"""Collisions of models by the paper's rule and by that of the humans, side by side."""

from __future__ import annotations

import duckdb
import pytest

from merge_runner.config import ScenarioConfig
from merge_runner_analysis.data.load import load_trials
from merge_runner_analysis.data.reference_data import human_counts
from merge_runner_analysis.data.study import Study
from merge_runner_analysis.explain import explain
from merge_runner_analysis.metrics import BOXES, COLLISIONS
from merge_runner_analysis.stats.intervals import wilson
from merge_runner_analysis.stats.measures import counts
from merge_runner_analysis.tables import make_tables
from tests.support.studies import Drive, changed, write_study, yielding

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
    return Study(write_study(path, HAND_MADE, STRONG))


def test_each_trial_is_judged_by_both_rules(study):
    (group,) = study.models
    trials = group.trials.set_index("rep")
    assert trials["collided"].to_dict() == {1: True, 2: False, 3: True, 4: True, 5: False}
    boxes = trials["collided_boxes"]
    assert boxes.drop([1, 3, 4]).to_dict() == {2: True, 5: False}
    assert boxes[[1, 3, 4]].isna().all()
    assert counts(group, COLLISIONS) == (3, 5)
    assert counts(group, BOXES) == (1, 2)


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
        assert "coll. boxes (%): 3 of 5 trials are undecided, since another collision rule" in note
        assert "between 20.0 and 80.0 %" in note
        assert any("boxes that overlap, looked for at 20 Hz" in note for note in table.notes)
    by_disc = next(r for r in indicators.rows if r.id == "o3/baseline/collided_percent")
    assert by_disc.note == ""


def test_a_driver_is_compared_with_humans_by_the_rule_of_the_humans(study, tmp_path):
    by_boxes = STRONG.model_copy(update={"collision_rule": "rectangle"})
    played = Study(write_study(tmp_path / "boxes.duckdb", HAND_MADE, by_boxes))
    (table,) = make_tables(played, ["verdicts"])
    found = next(row.values for row in table.rows if row.id == "o3/baseline/collisions")
    assert (found["k"], found["n"], found["undecided"]) == (2, 5, None)
    # In the conditions that it drove, as often as it drove them.
    rates = [human_counts()[name] for name in played.models[0].trials["condition"]]
    assert found["human"] == pytest.approx(100 * sum(of.collided / sum(of) for of in rates) / 5)


@pytest.mark.parametrize("measure", [COLLISIONS, BOXES])
def test_explain_lists_the_trials_that_are_decided(study, measure):
    (table,) = make_tables(study, ["indicators"])
    found = explain(study, table, f"o3/baseline/{measure.name}:n")
    (source,) = found.sources
    assert str(len(source.trials)) == found.value
    with duckdb.connect(str(study.db), read_only=True) as connection:
        rows = connection.execute(source.query).fetchall()
    assert tuple(trial_id for trial_id, *_ in rows) == source.trials


def test_humans_have_no_rate_by_the_drivers_rule_before_an_import_and_the_row_says_why(study):
    (table,) = make_tables(study, ["ablation-quantitative"])
    human = next(row for row in table.rows if row.id == "human")
    assert human.values.get("collided_percent") is None
    assert human.values["collided_boxes_percent"] == pytest.approx(100 * 28 / 990)
    assert "coll. (%): published human collisions are boxes that overlap" in human.note


@pytest.mark.slow
def test_longer_boxes_touch_where_shorter_ones_do_not(tmp_path):
    drives = [Drive("o3", "baseline", "L_4_0", 1, (0.1, 0.1), ())]
    for length_m, touching in ((4.5, False), (8.0, True)):
        scenario = ScenarioConfig(vehicle_length_m=length_m, collision_rule="shared_lane")
        path = write_study(tmp_path / f"{length_m}.duckdb", drives, scenario)
        (group,) = Study(path).models
        assert group.trials["collided_boxes"].tolist() == [touching]


def test_where_nothing_comes_near_both_rules_agree(tmp_path):
    db = write_study(tmp_path / "t.duckdb", yielding("o3", reps=2))
    (group,) = Study(db).models
    assert len(load_trials(db)) == 22
    assert counts(group, BOXES) == counts(group, COLLISIONS) == (0, 22)
