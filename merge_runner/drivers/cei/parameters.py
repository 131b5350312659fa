"""Constants of the model, thresholds of its drivers, and its nine synthetic pairs.

Equations and constants: Siebinga, Zgonnikov and Abbink, PNAS Nexus 3(10), pgae420 (2024), arXiv
2312.09776. The fitted thresholds of that paper are not public: the sets here are calibrated to its
published outcomes (docs/reference-drivers.md).
"""

from __future__ import annotations

from math import sqrt
from typing import NamedTuple

TICK_S = 0.05
# Nodes of a belief and of a plan: 24, up to 6 s ahead.
NODE_S, NODES = 0.25, 24
MEMORY_TICKS = 40
# Number of constant inputs in [-1, 1] that a plan is chosen from.
PLANS = 81
PLAN_NOISE = 0.025
# The perceived speed follows the other's with a time constant of 2 s, and wanders by 0.6 m/s.
PERCEPTION_RATE_HZ = 0.5
PERCEPTION_NOISE = 0.6  # m/s per square root of a second
# The cruise control of the human simulator: input by error of speed, in s/m, and by its change. At
# 10 m/s it leaves an error of 0.08 m/s, by which drivers start below the speed that they desire.
CRUISE_GAIN, CRUISE_DAMPING = 5.0, 0.05
# Factor of the spread in the second part of the risk, being too close.
BROADER = 3.0
LOWEST_BASE, NARROWEST_BAND = 0.02, 0.05
LOWEST_THRESHOLD, HIGHEST_THRESHOLD = 0.05, 1.0
# Highest risk of a new plan, as a share of the lower and of the upper threshold.
TO_LOWER, TO_UPPER = 0.8, 0.6


class Habits(NamedTuple):
    """Constants that all drivers share.

    ``comfortable_mps2`` is the expected acceleration of the other; after ``saturation_s`` of low
    risk the driver returns to its desired speed. Without ``noise``, perception and control are
    exact.
    """

    comfortable_mps2: float = 1.0
    saturation_s: float = 1.6
    noise: bool = True

    @property
    def saturation_ticks(self) -> int:
        """Saturation time in ticks."""
        return round(self.saturation_s / TICK_S)

    @property
    def remaining(self) -> float:
        """Share of an error of the perceived speed that is left after a tick."""
        return 1 - PERCEPTION_RATE_HZ * TICK_S if self.noise else 0.0

    @property
    def wander_mps(self) -> float:
        """Standard deviation of the noise that a tick adds to the perceived speed."""
        return PERCEPTION_NOISE * sqrt(TICK_S) if self.noise else 0.0


FITTING = Habits(comfortable_mps2=1.6, saturation_s=2.0, noise=False)
"""Habits of the agents that the authors fitted to their human drivers."""


class Base(NamedTuple):
    """Base thresholds of a driver, before its incentives."""

    lower: float
    upper: float


class ThresholdSet(NamedTuple):
    """Risk thresholds of all drivers: ten numbers.

    A driver's thresholds are ``mean - spread * z`` of its offset z, and change with its headway H
    (m, positive ahead) and its relative speed D (m/s, positive if faster) by
    ``headway * H + speed * D + product * H * D``.
    """

    lower_mean: float
    upper_mean: float
    lower_spread: float
    upper_spread: float
    lower_headway: float
    lower_speed: float
    lower_product: float
    upper_headway: float
    upper_speed: float
    upper_product: float

    def base(self, offset: float) -> Base:
        """Return the base thresholds of a driver."""
        lower = max(self.lower_mean - self.lower_spread * offset, LOWEST_BASE)
        upper = self.upper_mean - self.upper_spread * offset
        return Base(lower, max(upper, lower + NARROWEST_BAND))


RISKS = ("lower_mean", "upper_mean", "lower_spread", "upper_spread")
"""The first numbers of a set: each is a risk, from 0 to 1."""

# `python -m analysis.research.cei_calibration search` finds them again: K0 and drag-free for the
# published outcomes and the humans' first action, F1 for the outcomes alone.
SETS: dict[str, ThresholdSet] = {
    "K0": ThresholdSet(
        *(0.4218, 0.3586, 0.1412, 0.0076),
        *(0.0170, -0.0678, -0.0057, 0.0508, 0.0609, 0.0091),
    ),
    "F1": ThresholdSet(
        *(0.0957, 0.8409, 0.0537, 0.1318),
        *(-0.0190, -0.0361, 0.0167, 0.0681, 0.1063, -0.0357),
    ),
    "drag-free": ThresholdSet(
        *(0.4136, 0.3505, 0.1197, 0.0143),
        *(0.0052, -0.0601, -0.0034, 0.0378, 0.0523, 0.0037),
    ),
}


class Pair(NamedTuple):
    """Two drivers."""

    left: float
    right: float


# How much more than others each driver of the model's nine pairs changes its speed: the random
# intercepts of the published model in table S8b of its supplement, in m/s.
_INTERCEPTS = (
    *(Pair(0.50, -0.20), Pair(-1.13, 0.84), Pair(0.82, -1.09)),
    *(Pair(0.23, 0.14), Pair(0.50, -0.73), Pair(0.05, 0.40)),
    *(Pair(-0.75, 0.32), Pair(0.57, -0.27), Pair(0.00, -0.19)),
)
_SPREAD_MPS = 0.589  # of the 18 values
OFFSETS = tuple(Pair(pair.left / _SPREAD_MPS, pair.right / _SPREAD_MPS) for pair in _INTERCEPTS)
"""Offsets z of the drivers of the nine synthetic pairs, in standard deviations."""


def offsets_of(pair: int, repetition: int) -> Pair:
    """Return the offsets of a pair from 1 to 9; pair 0 takes turns by the repetition (from 1)."""
    return OFFSETS[(pair or repetition) % len(OFFSETS) - 1]
