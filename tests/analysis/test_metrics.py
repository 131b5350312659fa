"""The measures in SQL against the same definitions in plain Python."""

from __future__ import annotations

from itertools import pairwise
from math import sqrt

import numpy as np
import pytest
from studies import Drive, played, write_study

from analysis.load import load, load_trials
from merge_runner.simulator.collision import rectangles_overlap
from merge_runner.simulator.conditions import CONDITIONS

LENGTH_M = 4.5


@pytest.fixture(scope="module")
def drives():
    rng = np.random.default_rng(7)
    return [
        Drive("random", "baseline", name, rep, *(tuple(rng.uniform(-1, 1, 8)) for _ in "lr"))
        for name in CONDITIONS
        for rep in range(1, 8)
    ]


@pytest.fixture(scope="module")
def stored(drives, tmp_path_factory):
    db = write_study(tmp_path_factory.mktemp("metrics") / "m.duckdb", drives)
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


def overlap_bounds(at_m):
    """Between which positions the other vehicle overlaps one that stands at ``at_m``."""

    def edge(outside):
        inside = at_m
        for _ in range(40):
            middle = (inside + outside) / 2
            overlaps = rectangles_overlap(at_m, middle, 4.5, 1.8)
            inside, outside = (middle, outside) if overlaps else (inside, middle)
        return inside

    return edge(at_m - 6), edge(at_m + 6)


BOUNDS = {at_m: overlap_bounds(at_m) for at_m in (90.6066, 100.0, 150.0)}


def on_course(left_m, right_m, left_mps, right_mps):
    for (position, speed), (other, other_speed) in (
        ((left_m, left_mps), (right_m, right_mps)),
        ((right_m, right_mps), (left_m, left_mps)),
    ):
        for at_m, (low, high) in BOUNDS.items():
            if position < at_m and speed > 0:
                then = other + other_speed * (at_m - position) / speed
                if low < then < high:
                    return True
    return False


def test_every_measure_of_random_trials_equals_its_definition(drives, stored):
    _, trials = stored
    seen = set()
    for drive in drives:
        record = played(drive)
        row, trace = trials.loc[record.spec.trial_id], samples(record)
        seen.add(record.status)
        times = [passing(trace, side, 100) for side in (1, 2)]
        first = min((t for t in times if t is not None), default=None)
        assert row["time_to_merge_s"] == pytest.approx(first) if first else True
        assert row["max_acceleration_mps2"] == pytest.approx(max(s[5] for s in trace[1:]))
        closing = [
            (abs(s[1] - s[2]) - LENGTH_M) / rate
            for s in trace
            if max(s[1], s[2]) >= 100
            and (rate := (s[4] - s[3]) if s[1] > s[2] else (s[3] - s[4])) > 0
            and abs(s[1] - s[2]) > LENGTH_M
        ]
        assert (
            np.isnan(row["min_ttc_s"])
            if not closing
            else row["min_ttc_s"] == pytest.approx(min(closing))
        )
        free = [s[0] for s in trace if not on_course(*s[1:5])]
        if record.status == "collided" or not free:
            assert np.isnan(row["conflict_resolution_s"])
        else:
            assert row["conflict_resolution_s"] == pytest.approx(free[0])
        if record.status != "finished":
            for name in ("gap_m", "gap_first_sample_m", "gap_mean100_m", "rmse_mps", "joint",
                         "post_encroachment_s", "merge_interval_s"):  # fmt: skip
                assert row[name] is None or np.isnan(row[name]), name
            continue
        positions = at(trace, first)
        assert row["gap_m"] == pytest.approx(abs(positions[0] - positions[1]) - LENGTH_M)
        sampled = next(s for s in trace if max(s[1], s[2]) >= 100)
        assert row["gap_first_sample_m"] == pytest.approx(abs(sampled[1] - sampled[2]) - LENGTH_M)
        middle = next(s for s in trace if s[1] + s[2] >= 200)
        assert row["gap_mean100_m"] == pytest.approx(abs(middle[1] - middle[2]) - LENGTH_M)
        deviations = rmse(trace, CONDITIONS[drive.condition], first)
        assert row["rmse_left_mps"] == pytest.approx(deviations[0])
        assert row["rmse_right_mps"] == pytest.approx(deviations[1])
        assert row["rmse_mps"] == pytest.approx(sum(deviations) / 2)
        assert bool(row["joint"]) == (min(deviations) >= 0.5)
        second = 2 if times[0] == first else 1
        entry, leaving = passing(trace, second, 97.75), passing(trace, 3 - second, 102.25)
        if None in (entry, leaving):
            assert np.isnan(row["post_encroachment_s"])
        else:
            assert row["post_encroachment_s"] == pytest.approx(entry - leaving)
    assert {"finished", "collided"} <= seen


def test_the_windows_of_the_speed_deviation_end_where_they_say(drives, stored):
    db, _ = stored
    found = load("SELECT * FROM speed_deviations", db).set_index(["trial_id", "time_window"])
    checked = 0
    for drive in drives:
        record = played(drive)
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
