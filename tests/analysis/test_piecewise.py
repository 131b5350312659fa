"""Indicator I5: controls that must and must not pass, and the fit against slower ones."""

from __future__ import annotations

from dataclasses import asdict, replace

import numpy as np
import pandas as pd
import pytest
from hypothesis import given
from hypothesis import strategies as st
from ruptures import Pelt
from ruptures.base import BaseCost
from ruptures.costs import CostCLinear

from analysis.intervals import proportion
from analysis.piecewise import (
    FIELDS,
    MIN_SEGMENT_SAMPLES,
    SAMPLE_S,
    THRESHOLDS,
    TOLERANCE_MPS,
    Profile,
    at_5_hz,
    fit_each,
    fit_profile,
    fit_profiles,
    passing,
    segment_costs,
)

SAMPLES = 48  # 9.4 s, as long as a trial at 10 m/s
TRIALS = 30
# Speeds in 1/64 m/s: with whole shifts their differences are exact in binary.
SPEEDS = st.lists(st.integers(-200, 200), min_size=4, max_size=40).map(
    lambda steps: 10 + np.array(steps) / 64
)


def driven(accelerations) -> np.ndarray:
    """Speeds in m/s at 5 Hz under accelerations in m/s^2, one a step."""
    return 10 + np.concatenate([[0.0], np.cumsum(accelerations)]) * SAMPLE_S


def segments(rng) -> np.ndarray:
    """Constant accelerations, each held for 1.4 to 3 s."""
    accelerations: list[float] = []
    while len(accelerations) < SAMPLES - 1:
        accelerations += [rng.uniform(-1.5, 1.5)] * int(rng.integers(7, 16))
    return driven(accelerations[: SAMPLES - 1])


def wandering(rng) -> np.ndarray:
    """An Ornstein-Uhlenbeck acceleration, sampled at 0.2 s."""
    kept, deviation = np.exp(-SAMPLE_S / 0.6), 0.8
    acceleration = [rng.normal(0, deviation)]
    for _ in range(SAMPLES - 2):
        acceleration.append(
            kept * acceleration[-1] + rng.normal(0, deviation * (1 - kept**2) ** 0.5)
        )
    return driven(acceleration)


def tracking(rng) -> np.ndarray:
    """A proportional controller that follows a smoothly moving target speed."""
    frequency, phase, amplitude = rng.uniform([0.8, 0, 1], [1.6, 2 * np.pi, 2])
    v = [10.0]
    for step in range(SAMPLES - 1):
        target = 10 + amplitude * np.sin(frequency * step * SAMPLE_S + phase)
        v.append(v[-1] + SAMPLE_S * np.clip(1.5 * (target - v[-1]), -2.5, 2.5))
    return np.array(v)


def table(profiles) -> pd.DataFrame:
    """Profiles as the rows of ``fit_profiles``."""
    return pd.DataFrame([asdict(profile) for profile in profiles])


def share(controller, seed=1):
    """The share of trials whose profiles both pass, with its interval."""
    rng = np.random.default_rng(seed)
    passes = [
        passing(table(fit_profile(controller(rng)) for _ in "lr"), THRESHOLDS)
        for _ in range(TRIALS)
    ]
    return proportion(sum(p.all() for p in passes), TRIALS)


def test_constant_acceleration_in_segments_passes_as_a_group():
    assert share(segments).low >= THRESHOLDS.min_share


@pytest.mark.parametrize("controller", [wandering, tracking])
def test_continuous_control_fails_as_a_group(controller):
    found = share(controller)
    assert found.low < THRESHOLDS.min_share
    assert found.high < 0.5


@pytest.mark.parametrize("n", [4, 9, 30])
def test_the_cost_of_every_segment_is_that_of_ruptures(n):
    signal = np.random.default_rng(n).normal(10, 1, n)
    mine, reference = segment_costs(signal), CostCLinear().fit(signal)
    for start in range(n - 2):
        for end in range(start + 3, n + 1):
            found = mine[max(start, 1) - 1, end - 1]
            assert found == pytest.approx(reference.error(start, end), abs=1e-9)


class Tabulated(BaseCost):
    """Our costs, for ruptures' own search."""

    model = "tabulated"
    min_size = MIN_SEGMENT_SAMPLES

    def fit(self, signal):
        self.signal = signal.reshape(-1, 1)
        self.costs = segment_costs(signal)
        return self

    def error(self, start, end):
        return float(self.costs[max(start, 1) - 1, end - 1])


def plainly(velocity_mps) -> Profile:
    """The fit by ruptures' search, one vehicle at a time."""
    v = velocity_mps - velocity_mps[0]
    search = Pelt(custom_cost=Tabulated(), min_size=MIN_SEGMENT_SAMPLES, jump=1).fit(v)
    ends = search.predict(2 * np.log(len(v)) * TOLERANCE_MPS**2)
    knots = np.array([0, *(end - 1 for end in ends)])
    fitted = np.interp(np.arange(len(v)), knots, v[knots])
    seconds = (len(v) - 1) * SAMPLE_S
    acceleration = np.diff(v) / SAMPLE_S
    signs = np.sign(acceleration[np.abs(acceleration) > 0.05])
    return Profile(
        (len(knots) - 2) / seconds,
        float(np.sqrt(np.mean((v - fitted) ** 2))),
        float((signs[1:] != signs[:-1]).sum()) / seconds,
    )


@given(st.integers(4, 80), st.sampled_from((0.003, 0.01, 0.05, 0.2)), st.integers(0, 2**32))
def test_many_vehicles_at_once_are_fitted_as_ruptures_fits_each(n, roughness, seed):
    """Also to the last digit, as the same numbers are added in the same order."""
    v = 10 + np.cumsum(np.random.default_rng(seed).normal(0, roughness, (5, n)), axis=1)
    assert [Profile(*row) for row in fit_each(v).tolist()] == [plainly(row) for row in v]


@given(st.lists(SPEEDS, max_size=12))
def test_vehicles_of_any_length_are_fitted_in_their_order(speeds):
    frame = as_speeds((f"t{i}", "left", v) for i, v in enumerate(speeds))
    found = fit_profiles(frame)
    assert list(found["trial_id"]) == list(frame["trial_id"])
    assert [Profile(*row) for row in found[list(FIELDS)].to_numpy().tolist()] == [
        fit_profile(v) for v in speeds
    ]


def test_knots_are_where_the_acceleration_changes():
    """12 steps up, 15 down, 20 level: two knots in 9.4 s."""
    accelerations = [1.0] * 12 + [-0.8] * 15 + [0.0] * 20
    found = fit_profile(driven(accelerations))
    assert found.knot_rate_hz == pytest.approx(2 / 9.4)
    assert found.rmse_mps == pytest.approx(0, abs=1e-9)
    assert found.reversal_rate_hz == pytest.approx(1 / 9.4)


def test_knots_may_lie_0_6_s_apart_and_no_closer():
    apart = [0.0] * 10 + [2.0] * 3 + [0.0] * 10
    assert fit_profile(driven(apart)).rmse_mps == pytest.approx(0, abs=1e-9)
    assert fit_profile(driven(apart)).knot_rate_hz == pytest.approx(2 / 4.6)
    closer = [0.0] * 10 + [2.0] * 2 + [0.0] * 10
    assert fit_profile(driven(closer)).rmse_mps > 0.03


def test_noise_below_the_tolerance_makes_no_knots():
    for seed in range(10):
        noise = np.random.default_rng(seed).normal(0, 0.01, 31)
        found = fit_profile(driven([1.0] * 15 + [-1.0] * 15) + noise)
        assert found.knot_rate_hz == pytest.approx(1 / 6)
        assert 0 < found.rmse_mps < 0.03


@pytest.mark.parametrize(("excess", "knots"), [(0.95, 0), (1.05, 1)])
def test_a_knot_costs_two_logarithms_of_the_samples_at_the_tolerance(excess, knots):
    """A bend whose straight line leaves residuals just below or above 2 ln(n) * (0.03 m/s)^2."""
    n, bend = 31, 15
    tent = np.minimum(np.arange(n), n - 1 - np.arange(n)) / bend
    height = np.sqrt(excess * 2 * np.log(n) * 0.03**2 / (tent**2).sum())
    assert fit_profile(10 + height * tent).knot_rate_hz == pytest.approx(knots / 6)


def test_a_constant_speed_has_no_knots():
    for n in (4, 5, 48, 150):
        assert fit_profile(np.full(n, 9.6)) == Profile(0.0, 0.0, 0.0)


def test_the_residual_is_the_root_mean_square_over_all_samples():
    """Too short for a knot: a straight line from end to end, off by 0.3 and 0.6 inside."""
    found = fit_profile(np.array([10.0, 10.3, 10.6, 10.0]))
    assert found.rmse_mps == pytest.approx(np.sqrt((0.3**2 + 0.6**2) / 4))
    assert found.knot_rate_hz == 0


@pytest.mark.parametrize(
    ("accelerations", "reversals"),
    [
        ([1.0, 1.0, -1.0, -1.0, 1.0], 2),
        ([1.0, 0.0, 0.04, -1.0, -1.0], 1),  # through 0
        ([1.0, -0.04, 1.0, 0.0, 1.0], 0),  # below 0.05 m/s^2 there is no sign
        ([1.0, -0.06, 1.0, 0.0, 1.0], 2),
        ([0.0, 0.0, 0.0, 0.0, 0.0], 0),
    ],
)
def test_reversals_are_changes_of_the_accelerations_sign(accelerations, reversals):
    found = fit_profile(driven(accelerations))
    assert found.reversal_rate_hz == pytest.approx(reversals / 1.0)


@pytest.mark.parametrize("name", ["max_rmse_mps", "max_knot_rate_hz", "max_reversal_rate_hz"])
def test_a_profile_passes_up_to_each_limit(name):
    """0.7 knots and 0.5 reversals a second, and 0.1 m/s beside the polyline."""
    at = Profile(knot_rate_hz=0.7, rmse_mps=0.10, reversal_rate_hz=0.5)
    assert passing(table([at]), THRESHOLDS).all()
    lower = replace(THRESHOLDS, **{name: getattr(THRESHOLDS, name) - 1e-9})
    assert not passing(table([at]), lower).any()
    measure = name.removeprefix("max_")
    worse = replace(at, **{measure: getattr(at, measure) + 1e-9})
    assert not passing(table([worse]), THRESHOLDS).any()


@given(SPEEDS, st.integers(-9, 9))
def test_a_constant_added_to_the_speed_changes_nothing(v, shift):
    assert fit_profile(v + shift) == fit_profile(v)


@given(SPEEDS)
def test_a_mirrored_speed_has_the_same_profile(v):
    assert fit_profile(20 - v) == fit_profile(v)


def test_human_samples_at_20_hz_are_taken_at_5_hz():
    time = np.arange(200) * 0.05
    v = driven([0.9] * 20 + [-0.7] * 29)
    human = np.interp(time, np.arange(50) * SAMPLE_S, v)
    assert at_5_hz(time, human) == pytest.approx(v)
    assert fit_profile(at_5_hz(time, human)).knot_rate_hz == pytest.approx(1 / 9.8)


def test_samples_between_multiples_of_0_2_s_are_interpolated():
    time = np.array([0.0, 0.15, 0.33, 0.5])
    assert at_5_hz(time, 10 + 2 * time) == pytest.approx([10, 10.4, 10.8])


@pytest.mark.parametrize("steps", [3, 6, 7, 12, 47])
def test_speeds_at_5_hz_stay_as_they_are(steps):
    """Also where 0.6 / 0.2 falls just below 3 in binary."""
    time = np.array([round(0.2 * k, 9) for k in range(steps + 1)])
    v = np.random.default_rng(steps).normal(10, 1, steps + 1)
    assert list(at_5_hz(time, v)) == pytest.approx(list(v))


def as_speeds(rows) -> pd.DataFrame:
    """Trials, sides and speeds at 5 Hz as ``fit_profiles`` takes them."""
    return pd.DataFrame(
        [(trial, "h", side, list(np.arange(len(v)) * 0.2), list(v)) for trial, side, v in rows],
        columns=["trial_id", "spec_hash", "side", "time_s", "velocity_mps"],
    )


def test_a_vehicle_that_drove_for_less_than_four_samples_has_no_fit():
    v = driven([1.0] * 12 + [-0.8] * 15)
    speeds = as_speeds([("t1", "left", v), ("t1", "right", v[:4]), ("t2", "left", v[:3])])
    found = fit_profiles(speeds)
    assert found[["trial_id", "side"]].to_numpy().tolist() == [
        ["t1", "left"], ["t1", "right"], ["t2", "left"]
    ]  # fmt: skip
    assert Profile(*found.loc[0, list(FIELDS)]) == fit_profile(v)
    assert found[list(FIELDS)].isna().all(axis=1).tolist() == [False, False, True]
    assert list(fit_profiles(speeds[:0])) == list(found)
