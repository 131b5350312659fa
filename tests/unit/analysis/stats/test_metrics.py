"""The measures in SQL against the same definitions in plain Python."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from math import sqrt

import numpy as np
import pandas as pd
import pytest

from merge_runner.config import ScenarioConfig
from merge_runner.scenarios.merge.collision import rectangles_overlap
from merge_runner.scenarios.merge.conditions import CONDITIONS
from merge_runner.scenarios.merge.geometry import TRACK
from merge_runner_analysis.data.load import load, load_trials
from merge_runner_analysis.data.study import Study
from merge_runner_analysis.explain import explain
from merge_runner_analysis.metrics import SURROGATES
from merge_runner_analysis.tables.indicators import criticality
from tests.support.studies import Drive, played, write_study

SIZES = ((4.5, 1.8), (8.0, 2.5), (3.0, 1.2))


@pytest.fixture(scope="module", params=SIZES, ids=lambda size: "{} m x {} m".format(*size))
def scenario(request):
    length_m, width_m = request.param
    return ScenarioConfig(vehicle_length_m=length_m, vehicle_width_m=width_m)


@pytest.fixture(scope="module")
def drives():
    rng = np.random.default_rng(7)
    return [
        Drive("random", "baseline", name, rep, *(tuple(rng.uniform(-1, 1, 8)) for _ in "lr"))
        for name in CONDITIONS
        for rep in range(1, 8)
    ]


@pytest.fixture(scope="module")
def stored(drives, scenario, tmp_path_factory):
    db = write_study(tmp_path_factory.mktemp("metrics") / "m.duckdb", drives, scenario)
    return db, load_trials(db).set_index("trial_id")


def samples(record):
    """Per sample: time, positions and speeds of both, and the largest acceleration."""
    sides = {side: [s for s in record.states if s.side == side] for side in ("left", "right")}
    return [
        (
            left.time_s,
            left.position_m,
            right.position_m,
            left.velocity_mps,
            right.velocity_mps,
            max(abs(left.acceleration_mps2), abs(right.acceleration_mps2)),
        )
        for left, right in zip(sides["left"], sides["right"], strict=True)
    ]


def passing(trace, side, level_m):
    """When a vehicle passes a level, linear within the step."""
    for before, now in pairwise(trace):
        if before[side] < level_m <= now[side]:
            share = (level_m - before[side]) / (now[side] - before[side])
            return before[0] + share * (now[0] - before[0])
    return None


def at(trace, time_s):
    """Both positions at a time, linear within the step."""
    times = [sample[0] for sample in trace]
    return [np.interp(time_s, times, [sample[side] for sample in trace]) for side in (1, 2)]


def rmse(trace, condition, until_s):
    """RMSE of both speeds through the first sample at or after ``until_s``."""
    kept = []
    for sample in trace:
        kept.append(sample)
        if sample[0] >= until_s - 1e-12:
            break
    return [
        sqrt(
            sum((sample[3 + side] - condition.speeds_mps[side]) ** 2 for sample in kept) / len(kept)
        )
        for side in (0, 1)
    ]


def overlaps(scenario, left_m, right_m):
    return rectangles_overlap(
        TRACK, left_m, right_m, scenario.vehicle_length_m, scenario.vehicle_width_m
    )


def edge(overlap, inside, outside):
    """Where ``overlap`` ends between a place where it holds and one where it does not."""
    for _ in range(50):
        middle = (inside + outside) / 2
        inside, outside = (middle, outside) if overlap(middle) else (inside, middle)
    return inside


def conflict_points(scenario):
    """Where the vehicles can first touch, merge and end: (place, from, to) of the overlap there."""
    first_m = edge(lambda at_m: overlaps(scenario, at_m, at_m), 100.0, 50.0)
    for at_m in (first_m, 100.0, 150.0):

        def there(other_m, at_m=at_m):
            return overlaps(scenario, at_m, other_m)

        yield at_m, edge(there, at_m, at_m - 12), edge(there, at_m, at_m + 12)


def on_course(points, left_m, right_m, left_mps, right_mps):
    for (position, speed), (other, other_speed) in (
        ((left_m, left_mps), (right_m, right_mps)),
        ((right_m, right_mps), (left_m, left_mps)),
    ):
        for at_m, low, high in points:
            if position < at_m and speed > 0:
                then = other + other_speed * (at_m - position) / speed
                if low < then < high:
                    return True
    return False


def test_every_measure_of_random_trials_equals_its_definition(drives, scenario, stored):
    _, trials = stored
    seen = set()
    length_m, points = scenario.vehicle_length_m, list(conflict_points(scenario))
    for drive in drives:
        record = played(drive, scenario)
        row, trace = trials.loc[record.spec.trial_id], samples(record)
        seen.add(record.status)
        times = [passing(trace, side, 100) for side in (1, 2)]
        first = min((t for t in times if t is not None), default=None)
        assert row["time_to_merge_s"] == pytest.approx(first) if first else True
        assert row["max_acceleration_mps2"] == pytest.approx(max(s[5] for s in trace[1:]))
        closing = [
            (abs(s[1] - s[2]) - length_m) / rate
            for s in trace
            if max(s[1], s[2]) >= 100
            and (rate := (s[4] - s[3]) if s[1] > s[2] else (s[3] - s[4])) > 0.01
            and abs(s[1] - s[2]) > length_m
        ]
        assert (
            np.isnan(row["min_ttc_s"])
            if not closing
            else row["min_ttc_s"] == pytest.approx(min(closing))
        )
        free = [s[0] for s in trace if not on_course(points, *s[1:5])]
        if record.status == "collided" or not free:
            assert np.isnan(row["conflict_resolution_s"])
        else:
            assert row["conflict_resolution_s"] == pytest.approx(free[0])
        if record.status != "finished":
            for name in ("gap_m", "gap_first_sample_m", "gap_mean100_m", "rmse_mps", "joint",
                         "post_encroachment_s", "merge_interval_s"):  # fmt: skip
                assert pd.isna(row[name]), name
            continue
        positions = at(trace, first)
        assert row["gap_m"] == pytest.approx(abs(positions[0] - positions[1]) - length_m)
        sampled = next(s for s in trace if max(s[1], s[2]) >= 100)
        assert row["gap_first_sample_m"] == pytest.approx(abs(sampled[1] - sampled[2]) - length_m)
        middle = next(s for s in trace if s[1] + s[2] >= 200)
        assert row["gap_mean100_m"] == pytest.approx(abs(middle[1] - middle[2]) - length_m)
        deviations = rmse(trace, CONDITIONS[drive.condition], first)
        assert row["rmse_left_mps"] == pytest.approx(deviations[0])
        assert row["rmse_right_mps"] == pytest.approx(deviations[1])
        assert row["rmse_mps"] == pytest.approx(sum(deviations) / 2)
        assert bool(row["joint"]) == (min(deviations) >= 0.5)
        second = 2 if times[0] == first else 1
        entry = passing(trace, second, 100 - length_m / 2)
        leaving = passing(trace, 3 - second, 100 + length_m / 2)
        if None in (entry, leaving):
            assert np.isnan(row["post_encroachment_s"])
        else:
            assert row["post_encroachment_s"] == pytest.approx(entry - leaving)
    assert {"finished", "collided"} <= seen


def test_the_windows_of_the_speed_deviation_end_where_they_say(drives, scenario, stored):
    db, _ = stored
    found = load("SELECT * FROM speed_deviations", db).set_index(["trial_id", "time_window"])
    checked = 0
    for drive in drives:
        record = played(drive, scenario)
        if record.status != "finished":
            assert record.spec.trial_id not in found.index
            continue
        trace, condition = samples(record), CONDITIONS[drive.condition]
        times = [passing(trace, side, 100) for side in (1, 2)]
        ends = {"first_merge": min(t for t in times if t), "end": 99.0, "whole": 99.0}
        if None not in times:
            ends["both_merges"] = max(times)
            checked += 1
        for name, until in ends.items():
            row = found.loc[(record.spec.trial_id, name)]
            expected = rmse(trace, condition, until)
            assert [row["rmse_left_mps"], row["rmse_right_mps"]] == pytest.approx(expected), name
        assert ((record.spec.trial_id, "both_merges") in found.index) == (None not in times)
    assert checked > 5


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
    study = Study(write_study(tmp_path / "hand.duckdb", ends))
    assert set(study.models[0].trials["status"]) == {"finished", "collided"}
    table = criticality(study)
    (row,) = table.rows
    counts = {"min_ttc_s": 1, "conflict_resolution_s": 2, "max_acceleration_mps2": 2}
    assert row.values["n"] == 3
    for name, n in counts.items():
        assert row.values[f"{name}_n"] == n
        for column in (name, f"{name}_n"):
            (source,) = explain(study, table, f"hand/baseline:{column}").sources
            assert len(source.trials) == n
    assert any("medians are of finished trials" in note for note in table.notes)


@pytest.mark.parametrize(("closing_mps", "in_conflict"), [(0.009, False), (0.011, True)])
def test_vehicles_that_close_in_by_a_centimetre_a_second_are_in_no_conflict(
    closing_mps, in_conflict, tmp_path
):
    """From 14 and 8 m/s the one ahead brakes for 4 s, until it is that much slower."""
    braking = (-(6 + closing_mps) / 10,) * 4
    drive = Drive("hand", "baseline", "L_4_0", 1, (0.8, 0.8, *braking), (-0.4, -0.4))
    study = Study(write_study(tmp_path / "hand.duckdb", [drive]))
    table = criticality(study)
    row = table.rows[0]
    assert any("never close in faster than 0.01 m/s are in no conflict" in n for n in table.notes)
    if in_conflict:
        assert row.values["min_ttc_s"] == pytest.approx(17.5 / closing_mps, rel=0.01)
    else:
        assert row.values.get("min_ttc_s") is None
        assert row.note == "min. TTC (s): no trial has it"
