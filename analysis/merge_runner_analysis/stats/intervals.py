"""Confidence intervals of proportions, means and differences, and detectable effects.

Tests are Student's t by the functions that scipy.stats.t calls, which takes 100 times as long.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cache
from math import hypot, inf, sqrt

import numpy as np
import scipy
from scipy import special

from merge_runner_analysis.stats.estimate import Array, Estimate
from merge_runner_analysis.stats.score_interval import wilson

LEVEL = 0.95
POWER = 0.8
ROUNDING = 1e-12
TINY = 1e-300


def proportion(successes: int, n: int) -> Estimate:
    """Return a proportion with its Wilson interval (1927), exact at 0 and 1."""
    if n == 0:
        return Estimate()
    return Estimate(successes / n, *wilson(successes / n, n), n)


def melded(
    first: tuple[float, float], second: tuple[float, float], p: float, level: float = LEVEL
) -> tuple[float, float]:
    """Return the interval of one rate less another, (rate, trials) each, that agrees with ``p``.

    The melded interval (Fay, Proschan and Brittain 2015) agrees with one-sided tests. Fisher's p
    has unequal sides: the end next to 0 leaves out the share of its side, so that both agree.
    """
    alpha = 1 - level
    less, more = _at_most(first, second), _at_most(second, first)
    tails = [less(0.0), more(0.0)]
    near = min(tails)
    share = min(alpha * near / max(p, TINY), (1 + near) / 2)
    part = max(alpha / 2, share) if p < alpha else min(alpha / 2, share)
    parts = [part if place == tails.index(near) else alpha / 2 for place in (0, 1)]
    return _lower(less, parts[0]), -_lower(more, parts[1])


def _lower(at_most: Callable[[float], float], part: float) -> float:
    """Return the lower end of the melded interval of a difference, which leaves this part out."""
    if at_most(-1.0) >= part:
        return -1.0
    return float(scipy.optimize.brentq(lambda at: at_most(at) - part, -1.0, 1.0))


def _at_most(first: tuple[float, float], second: tuple[float, float]) -> Callable[[float], float]:
    """Return the chance that a lowest rate exceeds a highest one by at most a difference.

    They are the beta distributions of Clopper and Pearson (1934).
    """
    (rate, n), (share, m) = first, second
    k, missed = rate * n, m - share * m
    if k < ROUNDING:
        if missed < ROUNDING:
            return lambda _: 1.0
        return lambda at: 1 - float(_beta(share * m + 1, missed, -at))
    nodes, weights = _chances()
    most = special.betaincinv(share * m + 1, missed, nodes) if missed > ROUNDING else 1 + 0 * nodes
    return lambda at: float(weights @ _beta(k, n - k + 1, most + at))


@cache
def _chances() -> tuple[Array, Array]:
    """Return points and weights of Gauss and Legendre's rule on 0 to 1."""
    points, weights = np.polynomial.legendre.leggauss(200)
    return (1 + points) / 2, weights / 2


def _beta(a: float, b: float, x: float | Array) -> Array:
    return np.asarray(special.betainc(a, b, np.clip(x, 0.0, 1.0)))


def mean(values: Sequence[float] | Array) -> Estimate:
    """Return a mean with its interval of Student's t; fewer than two numbers have no interval."""
    sample = np.asarray(values, dtype=float)
    sample = sample[np.isfinite(sample)]
    n = len(sample)
    if n < 2:
        return Estimate(float(sample[0]) if n else None, n=n)
    return estimate(float(sample.mean()), float(sample.std(ddof=1) / sqrt(n)), n - 1, n)


def estimate(value: float, se: float, freedom: float, n: int) -> Estimate:
    """Return an estimate with its interval of Student's t."""
    return Estimate(value, *interval(value, se, freedom), n, se, freedom)


def interval(
    value: float, se: float, freedom: float = inf, level: float = LEVEL
) -> tuple[float, float]:
    """Return the interval of an estimate with this standard error, by Student's t."""
    half = float(special.stdtrit(freedom, (1 + level) / 2)) * se
    return value - half, value + half


def at(result: Estimate, level: float) -> Estimate:
    """Return the estimate with its interval at a level, or without ends if there are none."""
    ends = None
    if result.ends_at:
        ends = result.ends_at(level)
    elif result.value is not None and result.se is not None:
        ends = interval(result.value, result.se, result.freedom, level)
    low, high = ends or (None, None)
    return replace(result, low=low, high=high, level=level)


def two_sided_p(statistic: float, freedom: float = inf) -> float:
    """Return the p-value of a t statistic against no effect, in either direction."""
    return float(2 * special.stdtr(freedom, -abs(statistic)))


def tested(value: float, se: float, freedom: float) -> Estimate:
    """Return a difference with this standard error, tested against 0 by Student's t."""
    # Equal but for rounding is equal; where nothing varies, any other difference is sure.
    statistic = 0.0 if abs(value) < ROUNDING else value / se if se else inf
    p = two_sided_p(statistic, freedom)
    ends = interval(value, se, freedom)
    return Estimate(value, *ends, se=se, freedom=freedom, p=p, detectable=detectable(se, freedom))


def difference(first: Estimate, second: Estimate) -> Estimate | None:
    """Return one independent estimate less another, by the test of Welch (1947).

    None if a value or a standard error is missing, or if both errors are 0.
    """
    if first.value is None or second.value is None or first.se is None or second.se is None:
        return None
    if not (se := hypot(first.se, second.se)):
        return None
    spread = first.se**4 / first.freedom + second.se**4 / second.freedom
    return tested(first.value - second.value, se, se**4 / spread if spread else inf)


def detectable(se: float, freedom: float = inf) -> float:
    """Return the minimum detectable effect of a t test: t.975 + t.8 standard errors."""
    quantiles = special.stdtrit(freedom, np.array([(1 + LEVEL) / 2, POWER]))
    return float(quantiles.sum()) * se
