"""Confidence intervals of proportions and means, and what could have been found."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import sqrt

import numpy as np
from scipy import stats

LEVEL = 0.95
POWER = 0.8
Z = float(stats.norm.ppf((1 + LEVEL) / 2))


@dataclass(frozen=True, slots=True)
class Estimate:
    """A value with its 95 % interval and the number it rests on; None where there is none."""

    value: float | None
    low: float | None
    high: float | None
    n: int


def proportion(successes: int, n: int) -> Estimate:
    """A proportion with its Wilson score interval (Wilson 1927)."""
    if n == 0:
        return Estimate(None, None, None, 0)
    z, p = Z, successes / n
    middle = (p + z**2 / (2 * n)) / (1 + z**2 / n)
    half = z / (1 + z**2 / n) * sqrt(p * (1 - p) / n + z**2 / (4 * n**2))
    # The exact bounds at 0 and n are 0 and 1; rounding must not leave the estimate outside.
    return Estimate(p, min(p, max(0.0, middle - half)), max(p, min(1.0, middle + half)), n)


def mean(values: Sequence[float] | np.ndarray) -> Estimate:
    """A mean with its interval of Student's t; no interval for fewer than two values."""
    sample = np.asarray(values, dtype=float)
    sample = sample[np.isfinite(sample)]
    n = len(sample)
    if n < 2:
        return Estimate(float(sample[0]) if n else None, None, None, n)
    value = float(sample.mean())
    half = float(stats.t.ppf((1 + LEVEL) / 2, n - 1) * sample.std(ddof=1) / sqrt(n))
    return Estimate(value, value - half, value + half, n)


def detectable(se: float, freedom: float) -> float:
    """The smallest effect that a two-sided t test at 5 % finds with a power of 0.8."""
    return float(stats.t.ppf((1 + LEVEL) / 2, freedom) + stats.t.ppf(POWER, freedom)) * se
