"""The measures in SQL against the same definitions, written independently."""

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest

from analysis.research.independent import recompute_trials
from merge_runner.config import ScenarioConfig
from merge_runner.scenarios.merge.conditions import CONDITIONS
from merge_runner_analysis.explain import explain
from merge_runner_analysis.frames import load, load_trials
from merge_runner_analysis.metrics import BOXES, RMSE, SURROGATES, register
from merge_runner_analysis.selection import Selection
from merge_runner_analysis.stats.measures import counts, estimate
from merge_runner_analysis.study import StudyResults
from tests.support.studies import Drive, played, write_study, yielding
from tests.support.tables import made, notes_with

# Our columns, and those of the recomputation.
RECOMPUTED = {
    "gap_m": "gap", "gap_mean100_m": "gap_mean100", "rmse_mps": "rmse", "joint": "joint",
    "time_to_merge_s": "time_to_merge", "post_encroachment_s": "pet", "min_ttc_s": "ttc",
    "max_acceleration_mps2": "hardest",
}  # fmt: skip
ASKED = {"endpoint": "openai", "body": {"model": "random"}}
CHANCE = np.random.default_rng(7)
DRIVES = [
    Drive("random", "baseline", name, rep, *(tuple(CHANCE.uniform(-1, 1, 8)) for _ in "lr"))
    for name in CONDITIONS
    for rep in range(1, 6)
]


@pytest.fixture(scope="module")
def stored(tmp_path_factory):
    """Random trials: their database, and the records."""
    db = write_study(tmp_path_factory.mktemp("metrics") / "m.duckdb", DRIVES, asked=ASKED)
    return db, [played(drive) for drive in DRIVES]


def samples(record):
    """Per sample: time, positions and speeds of both."""
    sides = ([s for s in record.states if s.side == side] for side in ("left", "right"))
    return [
        (one.time_s, one.position_m, two.position_m, one.velocity_mps, two.velocity_mps)
        for one, two in zip(*sides, strict=True)
    ]


def test_the_measures_of_random_trials_are_those_of_the_recomputation(stored):
    db, _ = stored
    own = recompute_trials.read(str(db))
    own = own.set_index(own["way"].map(lambda way: way[0][0]))
    own = own[own["status"] == "finished"]
    found = load_trials(db).set_index("trial_id").loc[own.index]
    assert len(found) > 10
    trials = load_trials(db)
    resolved = trials["conflict_resolution_s"]  # as a search for overlaps on the way found it
    assert (resolved.count(), resolved.sum()) == (25, pytest.approx(13))
    unfinished = trials.query("status != 'finished'")
    missing = ["gap_m", "gap_first_sample_m", "gap_mean100_m", "rmse_mps", "joint",
               "post_encroachment_s", "merge_interval_s"]  # fmt: skip
    assert unfinished[missing].isna().all(axis=None)
    for name, same in RECOMPUTED.items():
        expected = own[same].to_numpy(float)
        assert found[name].to_numpy(float) == pytest.approx(expected, nan_ok=True), name


def test_the_windows_of_the_speed_deviation_end_where_they_say(stored):
    db, records = stored
    found = load("SELECT * FROM speed_deviations", db).set_index(["trial_id", "time_window"])
    of_trials = load("SELECT * FROM trial_metrics", db).set_index("trial_id")
    sides = ["rmse_left_mps", "rmse_right_mps"]
    for record in records:
        if record.status != "finished":
            assert record.spec.trial_id not in found.index
            continue
        trace = np.array(samples(record))
        passed = [np.argmax(trace[:, 1 + k] >= 100) for k in (0, 1)]
        both = min(trace[-1, 1:3]) >= 100
        ends = {"first_merge": min(k for k in passed if k), "end": len(trace), "whole": len(trace)}
        for name, last in (ends | ({"both_merges": max(passed)} if both else {})).items():
            apart = trace[: last + 1, 3:5] - CONDITIONS[record.spec.condition].speeds_mps
            expected = np.sqrt((apart**2).mean(axis=0))
            row = found.loc[(record.spec.trial_id, name), sides].to_numpy(float)
            assert row == pytest.approx(expected), name
            if name == "first_merge":
                assert [*of_trials.loc[record.spec.trial_id, sides]] == [*row]
        assert ((record.spec.trial_id, "both_merges") in found.index) == both


def test_the_measures_of_vehicles_of_8_m_are_those_worked_out_by_hand(tmp_path):
    """Left starts at 54 m and speeds up by 2 m/s^2 for 2 s, right at 50 m slows down by 1 m/s^2.

    From then on left is at 78 m + 14 m/s (t - 2 s), right at 68 m + 8 m/s (t - 2 s). In the second
    trial left brakes by 2.5 m/s^2 from 4 s to 7 s: it stands at 136.75 m with 6.5 m/s, right at
    108 m, and the track ends before the sample at 9.2 s.
    """
    right = (-0.4, -0.4)
    steady = Drive("hand", "baseline", "L_4_0", 1, (0.8, 0.8), right)
    braking = Drive("hand", "baseline", "L_4_0", 2, (0.8, 0.8, 0, 0, -1, -1, -1), right)
    db = write_study(
        tmp_path / "hand.duckdb", [steady, braking], ScenarioConfig(vehicle_length_m=8.0)
    )
    first, second = load_trials(db).sort_values("rep").to_dict("records")
    expected = {
        # Left is at 100 m after 2 s + 22/14 s, right at 68 m + 8 * 22/14 m.
        "time_to_merge_s": 3.571429,
        "gap_m": 32 - 8 * 22 / 14 - 8,
        "gap_first_sample_m": (78 + 14 * 1.6) - (68 + 8 * 1.6) - 8,
        # The mean is at 100 m after 2 s + 54/22 s: the sample at 4.6 s.
        "gap_mean100_m": (78 + 14 * 2.6) - (68 + 8 * 2.6) - 8,
        "merge_interval_s": 32 / 8 - 22 / 14,
        # Left's rear is there with its centre at 104 m, right's front with its own at 96 m.
        "post_encroachment_s": 28 / 8 - 26 / 14,
        # From 0.4 s on constant speeds lead into no overlap.
        "conflict_resolution_s": 0.4,
    }
    assert {name: first[name] for name in expected} == pytest.approx(expected)
    assert np.isnan(first["min_ttc_s"])
    closing_mps, distance_m = 8 - 6.5, (136.75 + 6.5 * 2.2) - (108 + 8 * 2.2)
    assert second["min_ttc_s"] == pytest.approx((distance_m - 8) / closing_mps)


def test_no_measure_prefers_a_side(tmp_path):
    """Also where the front of the second vehicle is at the merge point, and its centre never."""
    drives = [
        replace(drive, driver=driver)
        for rep, brakes in enumerate(np.linspace(0.05, 0.75, 36), 1)
        for driver, drive in {
            "ahead": Drive("", "baseline", "L_4_0", rep, (0.0,), (-brakes,) * 4),
            "mirrored": Drive("", "baseline", "R_-4_0", rep, (-brakes,) * 4, (0.0,)),
        }.items()
    ]
    trials = load_trials(write_study(tmp_path / "mirror.duckdb", drives)).set_index("rep")
    one, other = (trials[trials["model_left"] == name] for name in ("ahead", "mirrored"))
    other = other.rename(
        columns={"rmse_left_mps": "rmse_right_mps", "rmse_right_mps": "rmse_left_mps"}
    )
    columns = ["gap_m", "rmse_left_mps", "rmse_right_mps", "joint", *SURROGATES]
    pd.testing.assert_frame_equal(one[columns], other[columns])
    only_front = one["post_encroachment_s"].notna() & one["merge_interval_s"].isna()
    assert only_front.any()


def test_each_median_of_criticality_says_of_how_many_finished_trials_it_is(tmp_path):
    ends = [
        Drive("hand", "baseline", "L_4_0", 1, (0.8, 0.8), (-0.4, -0.4)),
        Drive("hand", "baseline", "L_4_0", 2, (0.8, 0.8, 0, 0, -1, -1, -1), (-0.4, -0.4)),
        Drive("hand", "baseline", "N_0_0", 1, (0.0,), (0.0,)),
    ]
    study = StudyResults(write_study(tmp_path / "hand.duckdb", ends))
    table = made(study, "criticality")
    (row,) = table.rows
    counts = {"min_ttc_s": 1, "conflict_resolution_s": 2, "max_acceleration_mps2": 2}
    assert row.values["n"] == 3
    for name, n in counts.items():
        assert row.values[f"{name}_n"] == n
        for column in (name, f"{name}_n"):
            (source,) = explain(study, table, f"hand/baseline:{column}").sources
            assert len(source.trials) == n
    assert notes_with(table, "medians are of finished trials")


@pytest.mark.parametrize(("closing_mps", "in_conflict"), [(0.009, False), (0.011, True)])
def test_vehicles_that_close_in_by_a_centimetre_a_second_are_in_no_conflict(
    closing_mps, in_conflict, tmp_path
):
    """From 14 and 8 m/s the one ahead brakes for 4 s, until it is that much slower."""
    braking = (-(6 + closing_mps) / 10,) * 4
    drive = Drive("hand", "baseline", "L_4_0", 1, (0.8, 0.8, *braking), (-0.4, -0.4))
    table = made(StudyResults(write_study(tmp_path / "hand.duckdb", [drive])), "criticality")
    (row,) = table.rows
    assert notes_with(table, "never close in faster than 0.01 m/s are in no conflict")
    if in_conflict:
        assert row.values["min_ttc_s"] == pytest.approx(17.5 / closing_mps, rel=0.01)
    else:
        assert row.note == "min. TTC (s): no trial has it"


@pytest.fixture
def added(own_parts):
    """Adds a metric for the length of a test."""

    def add(**changes):
        return register(replace(RMSE, paper_of_humans="", paper_of_drivers="", **changes))

    return add


@pytest.fixture(scope="module")
def db(tmp_path_factory):
    """o3 with a variant, once in every condition."""
    drives = [*yielding("o3", reps=1), *yielding("o3", "A1", reps=1)]
    return write_study(tmp_path_factory.mktemp("metrics") / "t.duckdb", drives)


def test_the_trials_of_a_share_are_those_that_it_is_found_in(added, imported):
    driven = added(
        name="driven_percent", estimator="proportion", trials="ended", value="end_time_s > 0"
    )
    human = StudyResults(imported.db, Selection(["human"])).human
    assert counts(human, driven) == (66, 66)
    assert counts(human, BOXES) == (28, 990)


def test_trials_whose_value_is_missing_or_no_finite_number_do_not_count(added, db):
    odd = added(
        name="odd_m",
        value="CASE condition WHEN 'N_0_0' THEN NULL WHEN 'L_4_0' THEN 'inf'::DOUBLE "
        "WHEN 'R_-4_0' THEN 'nan'::DOUBLE ELSE gap_m END",
    )
    slow = added(
        name="slow_percent",
        estimator="proportion",
        trials="ended",
        value="if(condition = 'N_0_0', NULL, condition LIKE 'L%')",
    )
    (group, _) = StudyResults(db).models
    assert estimate(group, odd).n == 11 - 3
    assert counts(group, slow) == (5, 10)


def test_a_rate_is_compared_and_a_median_is_not(added, db):
    added(name="a_percent", label="a", estimator="proportion", value="joint")
    added(name="c_mps", label="c", estimator="median")
    rows = {row.id for row in made(StudyResults(db), "contrasts").rows}
    assert "o3/A1/baseline/a_percent" in rows
    assert not any(name.endswith("c_mps") for name in rows)
