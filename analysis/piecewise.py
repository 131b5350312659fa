"""Is a velocity profile piecewise linear? Optimal partitioning of v(t), and indicator I5.

A vehicle's speed, sampled at 5 Hz from the start of control to the end of the trial, is fitted by
a continuous polyline whose knots lie at samples. The number of knots minimises
RSS / sigma^2 + 2 ln(n) per knot, a Bayesian information criterion with a known tolerance sigma.
With a zero-order hold every controller is piecewise linear at the scale of its steps, so what
counts is how few knots suffice and how well.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from ruptures import Pelt
from ruptures.base import BaseCost

Array = NDArray[np.float64]

SAMPLE_S = 0.2
TOLERANCE_MPS = 0.03
MIN_SEGMENT_SAMPLES = 3  # 0.6 s
STEADY_MPS2 = 0.05  # a smaller acceleration has no sign


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


class ContinuousPolyline(BaseCost):  # type: ignore[misc] # ruptures ships no types
    """Residual sums of squares of straight lines from sample to sample, all computed at once.

    Segments share their end samples, as with ruptures' own ``clinear``, which computes one segment
    at a time.
    """

    model = "continuous-polyline"
    min_size = MIN_SEGMENT_SAMPLES

    def fit(self, signal: Array) -> ContinuousPolyline:
        """Tabulate the cost of every segment of a signal of shape (n,)."""
        y = np.asarray(signal, dtype=float).ravel()
        self.signal = y.reshape(-1, 1)
        n = len(y)
        start, end = np.arange(n)[:, None], np.arange(n)[None, :]
        length = end - start
        slope = (y[None, :] - y[:, None]) / np.maximum(length, 1)
        sums = [np.concatenate([[0.0], np.cumsum(z)]) for z in (y, y * y, np.arange(n) * y)]
        # Sums over the samples after `start` up to `end`: of y, y^2 and (i - start) y.
        total, squares, moment = (s[None, 1:] - s[1:, None] for s in sums)
        moment = moment - start * total
        steps = length * (length + 1) / 2
        squared_steps = steps * (2 * length + 1) / 3
        first = y[:, None]
        self._table = (
            squares
            - 2 * first * total
            + length * first**2
            - 2 * slope * (moment - first * steps)
            + slope**2 * squared_steps
        )
        return self

    def error(self, start: int, end: int) -> float:
        """The cost of the segment that ends with sample ``end`` - 1."""
        return float(self._table[max(start, 1) - 1, end - 1])


def fit_profile(velocity_mps: Array) -> Profile:
    """Fit the speeds of one vehicle at 5 Hz, shape (n,) with n >= 4."""
    v = np.asarray(velocity_mps, dtype=float) - velocity_mps[0]
    penalty = 2 * np.log(len(v)) * TOLERANCE_MPS**2
    search = Pelt(custom_cost=ContinuousPolyline(), min_size=MIN_SEGMENT_SAMPLES, jump=1)
    ends = search.fit(v).predict(penalty)
    knots = np.array([0, *(end - 1 for end in ends)])
    fitted = np.interp(np.arange(len(v)), knots, v[knots])
    seconds = (len(v) - 1) * SAMPLE_S
    acceleration = np.diff(v) / SAMPLE_S
    signs = np.sign(acceleration[np.abs(acceleration) > STEADY_MPS2])
    return Profile(
        knot_rate_hz=(len(knots) - 2) / seconds,
        rmse_mps=float(np.sqrt(np.mean((v - fitted) ** 2))),
        reversal_rate_hz=float((signs[1:] != signs[:-1]).sum()) / seconds,
    )


def fit_profiles(speeds: pd.DataFrame) -> pd.DataFrame:
    """Fit all vehicles of ``load.SPEEDS`` that drove for at least 4 samples.

    Columns: trial_id, spec_hash, side, knot_rate_hz, rmse_mps, reversal_rate_hz.
    """
    names = ["trial_id", "spec_hash", "side", "knot_rate_hz", "rmse_mps", "reversal_rate_hz"]
    rows = []
    for row in speeds.itertuples():
        v = at_5_hz(np.asarray(row.time_s), np.asarray(row.velocity_mps))
        if len(v) > MIN_SEGMENT_SAMPLES:
            profile = fit_profile(v)
            rows.append(
                (
                    row.trial_id,
                    row.spec_hash,
                    row.side,
                    profile.knot_rate_hz,
                    profile.rmse_mps,
                    profile.reversal_rate_hz,
                )
            )
    return pd.DataFrame(rows, columns=names)


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
