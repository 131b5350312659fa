"""Indicator I5: controls that hold and that move, and the measure against a slower one."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from merge_runner.scenarios.merge.vehicle import net_acceleration
from merge_runner_analysis.data.intermittency import (
    CUBIC_SAMPLES,
    LINE_SAMPLES,
    SAMPLE_S,
    at_5_hz,
    gains,
    measure_profiles,
    residuals,
    without_resistance,
)
from tests.support import controls
from tests.support.controls import (
    CELLS,
    HELD,
    MOVING,
    candidates_table,
    clock_table,
    controls_table,
    separation,
)

DOCS = Path(__file__).parents[4] / "docs/reference/analysis.md"


@pytest.mark.parametrize("cell", CELLS, ids=str)
def test_held_accelerations_are_told_from_those_that_move(cell):
    assert separation(gains, HELD, MOVING, cell) >= 0.95


@pytest.mark.parametrize("moving", MOVING, ids=lambda control: control.__name__)
@pytest.mark.parametrize("cell", [c for c in CELLS if c[1] <= 0.02], ids=str)
def test_held_accelerations_are_told_from_each_that_moves(cell, moving):
    assert separation(gains, HELD, [moving], cell) >= 0.95


@pytest.mark.parametrize("control", HELD + MOVING, ids=lambda control: control.__name__)
def test_0_is_the_border(control):
    for rate_hz in controls.RATES_HZ:
        held = controls.measured(gains, control, rate_hz, 0.0) > 0
        assert held.mean() > 0.9 if control in HELD else held.mean() < 0.25


def test_the_docs_print_what_the_controls_give():
    text = DOCS.read_text("utf-8")
    assert candidates_table() in text
    assert controls_table() in text
    assert clock_table() in text
    at_random = "by chance each second, held, have a mean gain of 0.49 over 10 s"
    assert at_random in " ".join(text.split())


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


@pytest.mark.slow
@settings(max_examples=25)
@given(st.integers(5, 15), st.integers(0, 2**32))
def test_no_way_to_cut_a_profile_is_better(n, seed):
    v = random_speeds(seed, n)
    for found, degree, shortest in zip(
        residuals(v), (1, 3), (LINE_SAMPLES, CUBIC_SAMPLES), strict=True
    ):
        for row, speeds in enumerate(v):
            best = least(speeds, degree, shortest)
            assert found[: max(best), row] == pytest.approx(
                [best[k] for k in range(1, max(best) + 1)], abs=1e-9
            )
            assert np.isinf(found[max(best) :, row]).all()


def test_the_gain_is_the_difference_of_the_criteria_a_sample():
    """Two exact lines, 1 m/s^2 up and down: 5 numbers, and nothing left beside the tolerance."""
    v = 10 + np.minimum(np.arange(31), 30 - np.arange(31)) * SAMPLE_S
    lines, cubics = residuals(v[None])
    left = cubics[:, 0] / lines[0, 0]
    moving = min(31 * np.log(left[k] + 0.04**2) + (4 * (k + 1) + k) * np.log(31) for k in range(6))
    held = 31 * np.log(0.04**2) + 5 * np.log(31)
    assert gains(v[None]) == pytest.approx((moving - held) / 31)
    assert gains(v[None])[0] > 0.3


@settings(max_examples=25)
@given(st.integers(0, 2**32), st.floats(1, 4), st.floats(-5, 5), st.floats(-1, 1))
def test_neither_the_speed_nor_how_hard_one_drives_changes_the_gain(seed, scale, shift, slope):
    v = 3 * random_speeds(seed, 40)
    line = shift + slope * np.arange(40) * SAMPLE_S
    assert gains(scale * v + line) == pytest.approx(gains(v), abs=1e-6)
    assert gains(20 - v) == pytest.approx(gains(v), abs=1e-9)


def measured(v, step_s=SAMPLE_S, resisted=False) -> pd.Series:
    return measure_profiles(as_speeds([v], step_s, resisted)).iloc[0]


def as_speeds(speeds, step_s=SAMPLE_S, resisted=False) -> pd.DataFrame:
    """Vehicles as ``measure_profiles`` takes them."""
    rows = [
        (f"t{i}", "h", "left", list(np.arange(len(v)) * step_s), list(v), resisted)
        for i, v in enumerate(speeds)
    ]
    columns = ["trial_id", "spec_hash", "side", "time_s", "velocity_mps", "resisted"]
    return pd.DataFrame(rows, columns=columns)


@pytest.mark.parametrize("noise_mps", [0, 0.02])
def test_a_constant_speed_is_no_action(noise_mps):
    noise = np.random.default_rng(1).normal(0, noise_mps, 51)
    found = measured(np.full(51, 9.6) + noise)
    assert found["steady"]
    assert np.isnan(found["gain"])


def test_a_speed_that_leaves_its_mean_by_more_than_0_1_is_an_action():
    for height, steady in ((0.09, True), (0.11, False)):
        found = measured(10 + height * np.sin(2 * np.pi * np.arange(48) / 48))
        assert found["steady"] == steady == np.isnan(found["gain"])


def test_one_acceleration_from_beginning_to_end_is_held():
    assert measured(10 + 0.5 * np.arange(48) * SAMPLE_S)["gain"] > 0


def test_less_than_2_s_are_not_measured_and_are_no_constant_speed():
    v = random_speeds(1, 11, 1)[0]
    assert not np.isnan(measured(v)["gain"])
    assert np.isnan(measured(v[:10])["gain"])
    assert not measured(v[:10])["steady"]


@settings(max_examples=15)
@given(st.lists(st.integers(1, 40), max_size=8))
def test_vehicles_of_any_length_are_measured_in_their_order(lengths):
    speeds = [random_speeds(i, n, 1)[0] for i, n in enumerate(lengths)]
    found = measure_profiles(as_speeds(speeds))
    assert list(found["trial_id"]) == [f"t{i}" for i in range(len(lengths))]
    alone = [measured(v)["gain"] for v in speeds]
    assert list(found["gain"]) == pytest.approx(alone, nan_ok=True, abs=1e-12)


def test_a_pedal_that_is_held_against_the_resistance_is_a_straight_line():
    v = [10.0]
    for _ in range(200):
        v.append(v[-1] + 0.05 * net_acceleration(1.5, v[-1], "human"))
    time, v = np.arange(201) * 0.05, np.array(v)
    assert without_resistance(time, v) == pytest.approx(10 + 1.5 * time)
    assert measured(v, 0.05, resisted=True)["gain"] > 0 > measured(v, 0.05)["gain"]


def test_what_drag_did_not_make_is_left_in():
    """A vehicle that stands is held by nothing: its speed stays 0, and no line rises from it."""
    v = [2.0]
    for _ in range(100):
        v.append(max(0.0, v[-1] + 0.05 * net_acceleration(-0.5, v[-1], "human")))
    stands = v.index(0.0)
    time, v = np.arange(101) * 0.05, np.array(v)
    assert np.ptp(without_resistance(time, v)[stands:]) == 0
    assert v[stands - 1] > 0


def test_a_vehicle_that_nothing_but_drag_slows_took_no_action():
    v = [10.0]
    for _ in range(200):
        v.append(v[-1] + 0.05 * net_acceleration(0.0, v[-1], "human"))
    found = measured(np.array(v), 0.05, resisted=True)
    assert found["steady"]
    assert np.isnan(found["gain"])
    assert not measured(np.array(v), 0.05)["steady"]


def test_whoever_draws_an_acceleration_each_second_and_holds_it_has_a_gain_above_0():
    drawn = np.random.default_rng(1).uniform(-2.5, 2.5, (1000, 10))
    driven = controls.driven(np.repeat(drawn, 5, axis=1), SAMPLE_S)
    assert gains(driven).mean() == pytest.approx(0.49, abs=0.03)


def test_speeds_that_begin_later_are_measured_from_there():
    speeds = as_speeds([random_speeds(1, 20, 1)[0]])
    later = speeds.assign(time_s=[[t + 0.6 for t in one] for one in speeds["time_s"]])
    assert measure_profiles(later)["gain"][0] == pytest.approx(measure_profiles(speeds)["gain"][0])


def test_human_samples_at_20_hz_are_taken_at_5_hz():
    v = random_speeds(3, 50, 1)[0]
    time = np.arange(197) * 0.05
    assert at_5_hz(time, np.interp(time, np.arange(50) * SAMPLE_S, v)) == pytest.approx(v)


def test_samples_between_multiples_of_0_2_s_are_interpolated():
    time = np.array([0.0, 0.15, 0.33, 0.5])
    assert at_5_hz(time, 10 + 2 * time) == pytest.approx([10, 10.4, 10.8])


@pytest.mark.parametrize("steps", [3, 6, 7, 12, 47])
def test_speeds_at_5_hz_stay_as_they_are(steps):
    """Also where 0.6 / 0.2 falls just below 3 in binary."""
    time = np.array([round(0.2 * k, 9) for k in range(steps + 1)])
    v = np.random.default_rng(steps).normal(10, 1, steps + 1)
    assert list(at_5_hz(time, v)) == pytest.approx(list(v))
