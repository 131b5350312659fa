"""Differences between two groups of trials: exact and permutation tests, and corrections."""

from __future__ import annotations

from functools import cache, lru_cache
from math import ceil

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from scipy import optimize, special, stats

from analysis.stats.intervals import LEVEL, POWER, Difference, detectable, interval

SEED = 260409609
PERMUTATIONS = 9999
DRAWN_AT_ONCE = 2**15  # they stay in the processor


def contrast_rates(first: tuple[int, int], second: tuple[int, int]) -> Difference:
    """Two rates, (successes, n) each: Fisher's exact test, Newcombe's score interval (1998)."""
    from statsmodels.stats.proportion import confint_proportions_2indep

    (a, n), (b, m) = first, second
    low, high = confint_proportions_2indep(a, n, b, m, method="newcomb", alpha=1 - LEVEL)
    p = stats.fisher_exact([[a, n - a], [b, m - b]]).pvalue
    found = detectable_rate(n, m, b / m)
    return Difference(a / n - b / m, float(low), float(high), float(p), found)


def detectable_rate(n: int, m: int, rate: float) -> float | None:
    """The smallest difference from a true ``rate`` that Fisher's test of n and m trials finds.

    In the direction in which less is enough; None where not even rates of 0 and 1 are told apart
    from it with the power.
    """
    found = rejected(n, m) @ stats.binom.pmf(np.arange(m + 1), m, rate)

    def power(other: float) -> float:
        return float(stats.binom.pmf(np.arange(n + 1), n, other) @ found)

    ends = [end for end in (0.0, 1.0) if power(end) >= POWER]
    return min(
        (abs(optimize.brentq(lambda x: power(x) - POWER, rate, end) - rate) for end in ends),
        default=None,
    )


@cache
def rejected(n: int, m: int) -> NDArray[np.bool_]:
    """Of all outcomes, successes of n by successes of m, those with a Fisher's p below .05."""
    counts = np.arange(n + 1), np.arange(m + 1)
    # Log of k! (n - k)!: what is left of binomial coefficients when they are normalised.
    first, second = (special.gammaln(k + 1) + special.gammaln(k[::-1] + 1) for k in counts)
    found = np.empty((n + 1, m + 1), dtype=bool)
    for total in range(n + m + 1):
        a = np.arange(max(0, total - m), min(n, total) + 1)
        log = -first[a] - second[total - a]
        p = np.exp(log - log.max())
        p /= p.sum()
        order = np.argsort(p)
        # As likely but for rounding is as likely.
        last = np.searchsorted(p[order], p * (1 + 1e-7), side="right") - 1
        found[a, total - a] = np.cumsum(p[order])[last] < 1 - LEVEL
    return found


def contrast_means(first: pd.DataFrame, second: pd.DataFrame, measure: str) -> Difference | None:
    """Two means, compared within conditions: permutation test, least-squares interval.

    The difference is that of a linear model with a level for each condition, so that another mix of
    conditions, as when one group collides more in some, makes none. The test shuffles the groups
    within each condition, seeded. None where the groups share no condition.
    """
    both = pd.concat([first.assign(_first=1.0), second.assign(_first=0.0)]).dropna(subset=[measure])
    both = both.sort_values("condition", kind="stable")
    by_condition = both.groupby("condition")
    value = (both[measure].astype(float) - by_condition[measure].transform("mean")).to_numpy(float)
    group = (both["_first"] - by_condition["_first"].transform("mean")).to_numpy(float)
    # Of what is left of both within conditions, the slope is that of the whole model (Frisch and
    # Waugh 1933; Lovell 1963).
    weight = float((group**2).sum())
    if weight < 1e-12:  # no condition has trials of both groups
        return None
    difference = float((group * value).sum()) / weight
    freedom = len(both) - by_condition.ngroups - 1
    low = high = found = None
    if freedom > 0:
        variance = float(((value - difference * group) ** 2).sum()) / freedom
        se = float(np.sqrt(variance / weight))
        low, high = interval(difference, se, freedom)
        found = detectable(se, freedom)
    chosen = both["_first"].to_numpy(float) == 1
    sizes = by_condition.size().to_numpy()
    p = _permutation_p(value, chosen, sizes, weight, difference)
    return Difference(difference, low, high, p, found)


def _permutation_p(
    value: NDArray[np.float64],
    chosen: NDArray[np.bool_],
    sizes: NDArray[np.int_],
    weight: float,
    observed: float,
) -> float:
    """Share of shuffles within conditions, the observed one included, with as large a difference.

    ``value`` is centred within each condition; conditions lie one after another, in ``sizes``.
    """
    starts = np.cumsum(sizes) - sizes
    counts = np.add.reduceat(chosen.astype(int), starts)
    shuffles = _shuffles(tuple(zip(sizes.tolist(), counts.tolist(), strict=True)))
    values = np.split(value, starts[1:])
    parts = [shuffled_sums(*each) for each in zip(shuffles, values, strict=True)]
    # As large but for rounding is as large.
    extreme = int((np.abs(np.sum(parts, axis=0) / weight) >= abs(observed) - 1e-12).sum())
    # The trials as they are count as a shuffle, so that p is never 0 (Phipson and Smyth 2010).
    return (extreme + 1) / (PERMUTATIONS + 1)


@lru_cache(maxsize=16)
def _shuffles(conditions: tuple[tuple[int, int], ...]) -> list[NDArray[np.uint8]]:
    """Who comes first in the shuffles of conditions of (size, count); see ``first_in_shuffles``.

    The measures of two groups mostly have values in the same trials, and are shuffled alike.
    """
    rng = np.random.default_rng(SEED)
    return [first_in_shuffles(rng, size, count) for size, count in conditions]


def first_in_shuffles(rng: np.random.Generator, size: int, count: int) -> NDArray[np.uint8]:
    """Which ``count`` come first in each of PERMUTATIONS shuffles, (shuffle, bits of ``size``).

    Shuffled is by random draws: the ``count`` smallest come first, in whatever order.
    """
    found = np.zeros((PERMUTATIONS, ceil(size / 8)), dtype=np.uint8)
    drawn = np.empty((_rows(size), size))
    for start in range(0, PERMUTATIONS, len(drawn)):
        draws = drawn[: PERMUTATIONS - start]
        rng.random(out=draws)
        if count:
            last = np.partition(draws, count - 1, axis=1)[:, count - 1]
            found[start : start + len(drawn)] = np.packbits(draws <= last[:, None], axis=1)
    return found


def shuffled_sums(first: NDArray[np.uint8], value: NDArray[np.float64]) -> NDArray[np.float64]:
    """The sum of the values that come first in each shuffle."""
    rows = _rows(len(value))
    parts = [first[start : start + rows] for start in range(0, len(first), rows)]
    return np.concatenate([np.unpackbits(part, axis=1, count=len(value)) @ value for part in parts])


def _rows(size: int) -> int:
    """How many shuffles of that size are drawn at once."""
    return max(1, DRAWN_AT_ONCE // size)


def corrected(p: list[float]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """A family's p-values by Holm (1979) and by Benjamini and Hochberg (1995).

    Not by statsmodels' multipletests, which collects garbage at every call: 0.1 s each, and there
    is a family for every measure of every driver. A test holds both against each other.
    """
    found = np.asarray(p, dtype=float)
    order = np.argsort(found, kind="stable")
    # The smallest is multiplied by the number of tests, the next by one less, and none falls.
    steps = np.maximum.accumulate(found[order] * np.arange(len(found), 0, -1))
    holm = np.empty_like(found)
    holm[order] = np.minimum(steps, 1)
    return holm, np.asarray(stats.false_discovery_control(found))
