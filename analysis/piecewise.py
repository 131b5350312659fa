"""Is a velocity profile piecewise linear? Optimal partitioning of v(t), and indicator I5.

A vehicle's speed, sampled at 5 Hz from the start of control to the end of the trial, is fitted by
a continuous polyline whose knots lie at samples. The number of knots minimises
RSS / sigma^2 + 2 ln(n) per knot, a Bayesian information criterion with a known tolerance sigma.
With a zero-order hold every controller is piecewise linear at the scale of its steps, so what
counts is how few knots suffice and how well.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
import pandas as pd
from numpy.typing import NDArray

Array = NDArray[np.float64]

SAMPLE_S = 0.2
TOLERANCE_MPS = 0.03
MIN_SEGMENT_SAMPLES = 3  # 0.6 s
STEADY_MPS2 = 0.05  # a smaller acceleration has no sign
SEGMENTS_AT_ONCE = 2**18  # 2 MB an array


@dataclass(frozen=True, slots=True)
class Thresholds:
    """What a trial passes I5 with, on both vehicles; uncalibrated until human traces are there.

    ``max_reversal_rate_hz`` is the human 95th percentile once it can be computed. A set of trials
    passes where the Wilson lower bound of its share of passing trials reaches ``min_share``.
    """

    max_rmse_mps: float = 0.10
    max_knot_rate_hz: float = 0.7
    max_reversal_rate_hz: float = 0.5
    min_share: float = 0.8


THRESHOLDS = Thresholds()


@dataclass(frozen=True, slots=True)
class Profile:
    """One vehicle's fit: knots inside the profile per s, residual in m/s, reversals per s."""

    knot_rate_hz: float
    rmse_mps: float
    reversal_rate_hz: float


FIELDS = tuple(field.name for field in fields(Profile))


def segment_costs(y: Array) -> Array:
    """Residual sums of squares of straight lines from sample to sample, shape (..., n, n).

    Of signals of shape (..., n): the line from sample i to sample j, over the samples after i up to
    j. Segments share their end samples (the cost ``clinear`` of ruptures, Truong et al. 2020).
    """
    n = y.shape[-1]
    start, end = np.arange(n)[:, None], np.arange(n)[None, :]
    length = end - start
    first = y[..., :, None]
    slope = (y[..., None, :] - first) / np.maximum(length, 1)
    nothing = np.zeros((*y.shape[:-1], 1))
    sums = [
        np.concatenate([nothing, np.cumsum(z, axis=-1)], axis=-1)
        for z in (y, y * y, np.arange(n) * y)
    ]
    # Sums over the samples after `start` up to `end`: of y, y^2 and (i - start) y.
    total, squares, moment = (s[..., None, 1:] - s[..., 1:, None] for s in sums)
    moment = moment - start * total
    steps = length * (length + 1) / 2
    squared_steps = steps * (2 * length + 1) / 3
    costs = squares - 2 * first * total + length * first**2
    costs -= 2 * slope * (moment - first * steps)
    costs += slope**2 * squared_steps
    return np.asarray(costs)


def fit_profile(velocity_mps: Array) -> Profile:
    """Fit the speeds of one vehicle at 5 Hz, shape (n,) with n >= 4."""
    (values,) = fit_each(np.asarray(velocity_mps, dtype=float)[None])
    return Profile(*map(float, values))


def fit_each(velocity_mps: Array) -> Array:
    """Fit vehicles of equally many samples, (vehicles, n): rows with the fields of Profile."""
    v = velocity_mps - velocity_mps[:, :1]
    n = v.shape[1]
    knots = _knots(v)
    at = np.arange(n)
    before = np.maximum.accumulate(np.where(knots, at, 0), axis=1)
    after = np.minimum.accumulate(np.where(knots, at, n - 1)[:, ::-1], axis=1)[:, ::-1]
    low, high = (np.take_along_axis(v, place, axis=1) for place in (before, after))
    fitted = low + (high - low) / np.maximum(after - before, 1) * (at - before)
    seconds = (n - 1) * SAMPLE_S
    return np.column_stack(
        [
            (knots.sum(axis=1) - 2) / seconds,
            np.sqrt(np.mean((v - fitted) ** 2, axis=1)),
            _reversals(np.diff(v) / SAMPLE_S) / seconds,
        ]
    )


def _knots(v: Array) -> NDArray[np.bool_]:
    """Which samples are knots of the best polyline of each row, both ends among them.

    PELT (Killick et al. 2012) as ruptures has it, for all rows at once: the best way to each sample
    is one to an earlier sample and a line from there, which falls out once it costs a knot more.
    """
    rows, n = v.shape
    penalty = 2 * np.log(n) * TOLERANCE_MPS**2
    costs = segment_costs(v) + penalty
    # Of the first `end` samples: the lowest cost, and how many lie before the last segment.
    best, last = np.zeros((rows, n + 1)), np.zeros((rows, n + 1), int)
    open_ways = np.ones((rows, n + 1), bool)
    open_ways[:, 1:MIN_SEGMENT_SAMPLES] = False
    for end in range(MIN_SEGMENT_SAMPLES, n + 1):
        ways = end - MIN_SEGMENT_SAMPLES + 1
        starts = np.maximum(np.arange(ways), 1) - 1
        through = best[:, :ways] + costs[:, starts, end - 1]
        through[~open_ways[:, :ways]] = np.inf
        last[:, end] = through.argmin(axis=1)
        best[:, end] = through.min(axis=1)
        open_ways[:, :ways] &= through <= best[:, end, None] + penalty
    knots = np.zeros((rows, n), bool)
    knots[:, 0] = True
    ends = np.full(rows, n)
    while ends.any():
        knots[np.arange(rows), np.maximum(ends, 1) - 1] = True
        ends = last[np.arange(rows), ends]
    return knots


def _reversals(acceleration_mps2: Array) -> NDArray[np.int_]:
    """How often the sign changes in each row, samples without a sign left out."""
    sign = np.where(np.abs(acceleration_mps2) > STEADY_MPS2, np.sign(acceleration_mps2), 0)
    latest = np.maximum.accumulate(np.where(sign != 0, np.arange(sign.shape[1]), 0), axis=1)
    known = np.take_along_axis(sign, latest, axis=1)
    return np.asarray((known[:, 1:] * known[:, :-1] < 0).sum(axis=1))


def fit_profiles(speeds: pd.DataFrame) -> pd.DataFrame:
    """Fit vehicles, a row each with lists time_s and velocity_mps; NaN below 4 samples.

    Columns: trial_id, spec_hash, side, knot_rate_hz, rmse_mps, reversal_rate_hz.
    """
    sampled = [
        at_5_hz(np.asarray(time_s), np.asarray(velocity_mps))
        for time_s, velocity_mps in zip(speeds["time_s"], speeds["velocity_mps"], strict=True)
    ]
    values = np.full((len(sampled), len(FIELDS)), np.nan)
    places: dict[int, list[int]] = {}
    for place, v in enumerate(sampled):
        if len(v) > MIN_SEGMENT_SAMPLES:
            places.setdefault(len(v), []).append(place)
    for n, alike in places.items():
        step = max(1, SEGMENTS_AT_ONCE // n**2)
        for start in range(0, len(alike), step):
            chosen = alike[start : start + step]
            values[chosen] = fit_each(np.stack([sampled[place] for place in chosen]))
    keys = speeds[["trial_id", "spec_hash", "side"]].reset_index(drop=True)
    return keys.join(pd.DataFrame(values, columns=list(FIELDS)))


def passing(profiles: pd.DataFrame, limits: Thresholds) -> pd.Series:
    """Which rows of ``fit_profiles`` are piecewise linear with few knots."""
    return (
        (profiles["rmse_mps"] <= limits.max_rmse_mps)
        & (profiles["knot_rate_hz"] <= limits.max_knot_rate_hz)
        & (profiles["reversal_rate_hz"] <= limits.max_reversal_rate_hz)
    )


def at_5_hz(time_s: Array, velocity_mps: Array) -> Array:
    """The speeds at multiples of 0.2 s, linear between samples where they lie closer."""
    samples = int(np.floor(time_s[-1] / SAMPLE_S + 1e-9)) + 1 if len(time_s) else 0
    return np.asarray(np.interp(np.arange(samples) * SAMPLE_S, time_s, velocity_mps))
