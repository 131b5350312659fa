"""Indicator I5 of a vehicle: the measure against a slower one, and what counts as an action."""

from functools import cache

import numpy as np
import pandas as pd
import pytest

from merge_runner.scenarios.merge.vehicle import net_acceleration
from merge_runner_analysis.stats.held import (
    CUBIC_SAMPLES,
    LINE_SAMPLES,
    SAMPLE_S,
    at_5_hz,
    gains,
    measure_profiles,
    residuals,
    without_resistance,
)


def random_speeds(seed, n, rows=4):
    return 10 + np.cumsum(np.random.default_rng(seed).normal(0, 0.2, (rows, n)), axis=1)


def least(v, degree, shortest) -> dict[int, float]:
    """The least sum of squares by number of pieces: all ways to cut are tried."""

    @cache
    def beside(start, end):
        at = np.arange(start, end)
        fit = np.polynomial.Polynomial.fit(at, v[start:end], degree)
        return float(((v[start:end] - fit(at)) ** 2).sum())

    def ways(start):
        if start == len(v):
            yield 0, 0.0
        for end in range(start + shortest, len(v) + 1):
            for pieces, rest in ways(end):
                yield pieces + 1, beside(start, end) + rest

    found: dict[int, float] = {}
    for pieces, total in ways(0):
        found[pieces] = min(total, found.get(pieces, np.inf))
    return found


@pytest.mark.parametrize("n", [5, 8, 11, 14])
def test_no_way_to_cut_a_profile_is_better(n):
    v = random_speeds(n, n, rows=2)
    for found, degree, shortest in zip(
        residuals(v), (1, 3), (LINE_SAMPLES, CUBIC_SAMPLES), strict=True
    ):
        for row, speeds in enumerate(v):
            best = least(speeds, degree, shortest)
            expected = [best.get(k, np.inf) for k in range(1, len(found) + 1)]
            assert found[:, row] == pytest.approx(expected, abs=1e-9)


def test_the_gain_is_the_difference_of_the_criteria_a_sample():
    """Two exact lines, 1 m/s^2 up and down: 5 numbers, and nothing left beside the tolerance."""
    v = 10 + np.minimum(np.arange(31), 30 - np.arange(31)) * SAMPLE_S
    lines, cubics = residuals(v[None])
    left = cubics[:, 0] / lines[0, 0]
    moving = min(31 * np.log(left[k] + 0.04**2) + (4 * (k + 1) + k) * np.log(31) for k in range(6))
    held = 31 * np.log(0.04**2) + 5 * np.log(31)
    assert gains(v[None]) == pytest.approx((moving - held) / 31)
    assert gains(v[None])[0] > 0.3


def test_whoever_draws_an_acceleration_each_second_and_holds_it_has_a_gain_above_0():
    """As the page of the docs says, 0.49 over 10 s."""
    drawn = np.repeat(np.random.default_rng(1).uniform(-2.5, 2.5, (1000, 10)), 5, axis=1)
    speeds = 10 + np.cumsum(np.column_stack([np.zeros(1000), drawn * SAMPLE_S]), axis=1)
    assert gains(speeds).mean() == pytest.approx(0.49, abs=0.03)


def measured(v, step_s=SAMPLE_S, resisted=False) -> pd.Series:
    return measure_profiles(as_speeds([v], step_s, resisted)).iloc[0]


def as_speeds(speeds, step_s=SAMPLE_S, resisted=False, since_s=0.0) -> pd.DataFrame:
    """Vehicles as ``measure_profiles`` takes them."""
    rows = [
        (f"t{i}", "h", "left", list(since_s + np.arange(len(v)) * step_s), list(v), resisted)
        for i, v in enumerate(speeds)
    ]
    columns = ["trial_id", "spec_hash", "side", "time_s", "velocity_mps", "resisted"]
    return pd.DataFrame(rows, columns=columns)


NOISE = np.random.default_rng(1).normal(0, 0.02, 51)
WAVE = np.sin(2 * np.pi * np.arange(48) / 48)


@pytest.mark.parametrize(
    ("v", "steady"),
    [
        (np.full(51, 9.6), True),
        (9.6 + NOISE, True),
        (10 + 0.09 * WAVE, True),
        (10 + 0.11 * WAVE, False),  # it leaves its mean by more than 0.1 m/s
        (10 + 0.5 * np.arange(48) * SAMPLE_S, False),
    ],
)
def test_a_constant_speed_is_no_action(v, steady):
    found = measured(v)
    assert found["steady"] == steady == np.isnan(found["gain"])


def test_less_than_2_s_are_not_measured_and_are_no_constant_speed():
    (v,) = random_speeds(1, 11, 1)
    assert not np.isnan(measured(v)["gain"])
    assert np.isnan(measured(v[:10])["gain"])
    assert not measured(v[:10])["steady"]


def test_vehicles_of_any_length_and_beginning_are_measured_in_their_order():
    speeds = [random_speeds(i, n, 1)[0] for i, n in enumerate((20, 1, 40, 11, 20))]
    found = measure_profiles(as_speeds(speeds, since_s=0.6))
    assert list(found["trial_id"]) == [f"t{i}" for i in range(5)]
    alone = [measured(v)["gain"] for v in speeds]
    assert list(found["gain"]) == pytest.approx(alone, nan_ok=True, abs=1e-12)
    assert measure_profiles(as_speeds([])).empty


def resisted(start_mps, action_mps2, samples) -> np.ndarray:
    """Speeds at 20 Hz under an action, against drag."""
    v = [start_mps]
    for _ in range(samples):
        v.append(max(0.0, v[-1] + 0.05 * net_acceleration(action_mps2, v[-1], "human")))
    return np.array(v)


def test_a_pedal_that_is_held_against_the_resistance_is_a_straight_line():
    v, time = resisted(10.0, 1.5, 200), np.arange(201) * 0.05
    assert without_resistance(time, v) == pytest.approx(10 + 1.5 * time)
    assert measured(v, 0.05, resisted=True)["gain"] > 0 > measured(v, 0.05)["gain"]


def test_what_drag_did_not_make_is_left_in():
    """A vehicle that stands is held by nothing: its speed stays 0, and no line rises from it."""
    v = resisted(2.0, -0.5, 100)
    stands = list(v).index(0.0)
    assert v[stands - 1] > 0
    assert np.ptp(without_resistance(np.arange(101) * 0.05, v)[stands:]) == 0


def test_a_vehicle_that_nothing_but_drag_slows_took_no_action():
    v = resisted(10.0, 0.0, 200)
    assert measured(v, 0.05, resisted=True)["steady"]
    assert not measured(v, 0.05)["steady"]


def test_samples_are_taken_at_5_hz_and_interpolated_between():
    (v,) = random_speeds(3, 50, 1)
    time = np.arange(197) * 0.05
    assert at_5_hz(time, np.interp(time, np.arange(50) * SAMPLE_S, v)) == pytest.approx(v)
    time = np.array([0.0, 0.15, 0.33, 0.5])
    assert at_5_hz(time, 10 + 2 * time) == pytest.approx([10, 10.4, 10.8])


@pytest.mark.parametrize("steps", [3, 6, 7, 12, 47])
def test_speeds_at_5_hz_stay_as_they_are(steps):
    """Also where 0.6 / 0.2 falls just below 3 in binary."""
    time = np.array([round(0.2 * k, 9) for k in range(steps + 1)])
    v = np.random.default_rng(steps).normal(10, 1, steps + 1)
    assert list(at_5_hz(time, v)) == pytest.approx(list(v))
