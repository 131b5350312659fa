"""Differences between two groups of trials within cells: rates, means, and their corrections."""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cache, cached_property
from math import hypot, sqrt
from typing import Any

import numpy as np
import pandas as pd
import scipy
from numpy.typing import NDArray
from scipy import special

from merge_runner_analysis.stats.estimate import Array, Estimate
from merge_runner_analysis.stats.intervals import LEVEL, POWER, ROUNDING, tested, two_sided_p
from merge_runner_analysis.stats.score_interval import Z

# Where less of a trial's deviation is left over than this, it alone decides the difference.
LEVERAGE = 1e-9
NEAREST = 1e-9  # to a difference, of what it may be instead
PARTS = 2**40  # of a distance, as exact as a place in it is
LARGEST_Z = 30.0  # of this quantile p is 0 to 190 digits
Z_WITH_POWER = Z + float(special.ndtri(POWER))
Trials = Mapping[str, Any]  # columns, also of a data frame: condition, a measure, maybe row


@dataclass(frozen=True, eq=False)
class Cells:
    """Two rates by cell: successes and trials of the first, and of the second.

    ``varying`` is, by cell, the share of trials that add variance. A trial that counts in two
    cells, with opposite outcomes, adds none, as their sum is fixed.
    """

    a: NDArray[np.int_]
    n: NDArray[np.int_]
    b: NDArray[np.int_]
    m: NDArray[np.int_]
    varying: tuple[Array | float, Array | float] = (1.0, 1.0)

    @cached_property
    def shares(self) -> Array:
        """Weights of the cells, with the sum 1; a trial in two cells counts half in each."""
        n, m = (
            (1 + of) / 2 * size for of, size in zip(self.varying, (self.n, self.m), strict=True)
        )
        weights = n * m / (n + m)
        return np.asarray(weights / weights.sum(), dtype=float)

    @property
    def rates(self) -> tuple[float, float]:
        """Both rates, as means over cells with the weights of the difference."""
        return float(self.shares @ (self.a / self.n)), float(self.shares @ (self.b / self.m))

    @cached_property
    def difference(self) -> float:
        """The first rate less the second."""
        return float(self.shares @ (self.a / self.n - self.b / self.m))

    def variance(self, apart: float) -> float:
        """Return the variance of the difference if the rates differ by ``apart`` in every cell.

        It is unbiased, at the likeliest rates with this difference (Miettinen and Nurminen 1985).
        """
        n, m = self.n, self.m
        p, q = _likeliest(self.a, n, self.b, m, apart)
        every = n + m
        first_varying, second_varying = self.varying
        of_cells = (first_varying * p * (1 - p) / n + second_varying * q * (1 - q) / m) * every
        of_cells = of_cells / (every - 1)
        return float(self.shares**2 @ of_cells)

    def end(self, sign: int, z: float = Z) -> float:
        """Return the lower end (-1) or the upper one (1) of the score interval at a quantile."""
        value = self.difference

        def beyond(apart: float) -> float:
            return sign * (apart - value) - z * sqrt(self.variance(apart))

        far, near = float(sign), value + sign * NEAREST
        if sign * near >= 1 or beyond(far) <= 0:
            return far
        # The test of no difference says on which side of 0 the end lies.
        if sign * value < 0 and sign * near < 0:
            far, near = (0.0, near) if beyond(0.0) > 0 else (far, 0.0)
        return near if beyond(near) >= 0 else _crossing(beyond, near, far)

    @property
    def p(self) -> float:
        """The p-value of Fisher's exact test within cells, two-sided by probability."""
        from scipy.stats import hypergeom

        chances, least = np.ones(1), 0
        for a, n, b, m in zip(self.a, self.n, self.b, self.m, strict=True):
            possible = np.arange(max(0, a + b - m), min(n, a + b) + 1)
            chances = np.convolve(chances, hypergeom.pmf(possible, n + m, a + b, n))
            least += possible[0]
        # As likely but for rounding is as likely.
        likely = chances <= chances[self.a.sum() - least] * (1 + 1e-7)
        return min(1.0, float(chances[likely].sum() / chances.sum()))


def _likeliest(
    a: NDArray[np.int_], n: NDArray[np.int_], b: NDArray[np.int_], m: NDArray[np.int_], apart: float
) -> tuple[Array, Array]:
    """Return the likeliest rates that differ by ``apart`` (Miettinen and Nurminen 1985)."""
    every, hits = n + m, a + b
    square = (n + 2 * m) * apart - every - hits
    linear = (m * apart - every - 2 * b) * apart + hits
    middle = square / (3 * every)
    turn = middle**3 - square * linear / (6 * every**2) + b * apart * (1 - apart) / (2 * every)
    size = np.copysign(np.sqrt(np.maximum(middle**2 - linear / (3 * every), 0)), turn)
    cubed = np.where(size == 0, 1, size**3)
    angle = (np.pi + np.arccos(np.clip(turn / cubed, -1, 1))) / 3
    second = np.clip(2 * size * np.cos(angle) - middle, max(0, -apart), min(1, 1 - apart))
    return np.clip(second + apart, 0, 1), second


def shared_cells(first: Trials, second: Trials, measure: str) -> Cells | None:
    """Return the rates of two groups in the conditions of both, if there are any."""
    cells, belongs, hits, varies = _within_shared(first, second, measure)
    if not len(cells):
        return None
    a, n, first_varying, b, m, second_varying = (
        np.bincount(cells, of_group * counted).astype(int)
        for of_group in (belongs, 1 - belongs)
        for counted in (hits, 1, varies)
    )
    return Cells(a, n, b, m, (first_varying / n, second_varying / m))


def contrast_rates(cells: Cells) -> Estimate:
    """Compare two rates within cells: Mantel and Haenszel's test (1959), with a score interval.

    ``detectable`` is the difference with 80 % power; None if not even rates of 0 and 1 would differ
    significantly.
    """
    value, se = cells.difference, sqrt(cells.variance(0))
    ends = cells.end(-1), cells.end(1)
    p = two_sided_p(value / se) if se else 1.0
    surest = Cells(cells.n, cells.n, np.zeros_like(cells.n), cells.m)
    least = None
    if two_sided_p(1 / sqrt(surest.variance(0))) < 1 - LEVEL:
        sizes = [_detectable(cells, sign) for sign in (-1, 1)]
        least = min(filter(None, sizes), default=None)
    return Estimate(value, *ends, se=se, p=p, detectable=least)


def _detectable(cells: Cells, sign: int) -> float | None:
    def beyond(size: float) -> float:
        return size - Z_WITH_POWER * sqrt(cells.variance(sign * size))

    return None if beyond(NEAREST) >= 0 else _crossing(beyond, NEAREST, 1.0)


def _crossing(beyond: Callable[[float], float], near: float, far: float) -> float:
    """Return the place between two where a value that is below 0 ``near`` reaches 0.

    It is exact to a trillionth of the distance, as that of ``scipy.optimize``, which a page or a
    report would import for this alone, in 0.15 s.
    """

    def place(part: int) -> float:
        return near + (far - near) * part / PARTS

    return place(bisect_left(range(PARTS), 0.0, key=lambda part: beyond(place(part))))


def difference_of_contrasts(cells: Cells, others: Cells) -> Estimate:
    """Return an interaction, with its interval and p by MOVER (Zou and Donner 2008).

    Its standard error is 0 if nothing varies within any cell.
    """
    differences = cells.difference, others.difference
    value = differences[0] - differences[1]

    def half(sign: int, z: float) -> float:
        apart = (cells.end(sign, z) - differences[0], others.end(-sign, z) - differences[1])
        return hypot(*apart)

    def beyond(z: float) -> float:
        return half(-1 if value > 0 else 1, z) - abs(value)

    z = LARGEST_Z if abs(value) > ROUNDING else 0.0
    if z and beyond(z) >= 0:
        z = _crossing(beyond, 0.0, z)
    below, above = half(-1, Z), half(1, Z)
    least = Z_WITH_POWER / Z * min(below, above)
    se = least / Z_WITH_POWER if cells.variance(0) or others.variance(0) else 0.0
    return Estimate(value, value - below, value + above, se=se, p=two_sided_p(z), detectable=least)


def detectable_rate(n: int, m: int, rate: float) -> float | None:
    """Return the minimum detectable effect of Fisher's test of n and m trials at a true ``rate``.

    It is the smaller of both directions; None if no rate has the power.
    """
    from scipy.stats import binom

    chances = rejected(n, m) @ binom.pmf(np.arange(m + 1), m, rate)

    def enough(other: float) -> float:
        return float(binom.pmf(np.arange(n + 1), n, other) @ chances) - POWER

    ends = [end for end in (0.0, 1.0) if enough(end) >= 0]
    return min((abs(scipy.optimize.brentq(enough, rate, end) - rate) for end in ends), default=None)


@cache
def rejected(n: int, m: int) -> NDArray[np.bool_]:
    """Return by successes of n and of m whether Fisher's p is below .05."""
    is_rejected = np.empty((n + 1, m + 1), dtype=bool)
    ways = [-special.betaln(np.arange(k + 1) + 1, k + 1 - np.arange(k + 1)) for k in (n, m)]
    for total in range(n + m + 1):
        a = np.arange(max(0, total - m), min(n, total) + 1)
        # The hypergeometric distribution: but for constants, the ways to choose both.
        logarithms = ways[0][a] + ways[1][total - a]
        p = np.exp(logarithms - logarithms.max())
        p /= p.sum()
        order = np.argsort(p)
        # As likely but for rounding is as likely.
        last = np.searchsorted(p[order], p * (1 + 1e-7), side="right") - 1
        is_rejected[a, total - a] = np.cumsum(p[order])[last] < 1 - LEVEL
    return is_rejected


def contrast_means(first: Trials, second: Trials, measure: str) -> Estimate | None:
    """Compare two means within the conditions that both have, by Welch's test.

    The difference comes from a linear model with an intercept for each condition. Its standard
    error (HC2; MacKinnon and White 1985) and degrees of freedom (Bell and McCaffrey 2002) are valid
    if groups differ in size and variance. None if no condition is shared, or if one trial
    determines a coefficient; without a test if the values are equal within each condition.
    """
    cells, belongs, values, _ = _within_shared(first, second, measure)
    if not len(cells):
        return None
    trials = np.bincount(cells)[cells]
    # The slope of the residuals within conditions equals the whole model's (Frisch and Waugh
    # 1933; Lovell 1963).
    group, value = (
        column - np.bincount(cells, column)[cells] / trials for column in (belongs, values)
    )
    weight = float(group @ group)
    left_over = 1 - 1 / trials - group**2 / weight
    if left_over.min() < LEVERAGE:
        return None
    slope = float(group @ value) / weight
    squared = (value - slope * group) ** 2 / left_over
    se = float(np.sqrt((group**2 * squared).sum())) / weight
    variances = [float(squared[belongs == of].mean()) for of in (0.0, 1.0)]
    freedom = float(len(cells) - (cells.max() + 1) - 1)
    if se > ROUNDING:
        freedom = _freedom(cells, belongs, group, left_over, np.array(variances))
    elif abs(slope) < ROUNDING:
        return Estimate(0.0, se=0.0, freedom=freedom)
    return tested(slope, se, freedom)


def means_within(first: Trials, second: Trials, measure: str) -> tuple[float, float]:
    """Return both means over shared conditions, with the weights of their difference."""
    cells, belongs, values, _ = _within_shared(first, second, measure)
    n, m = np.bincount(cells, belongs), np.bincount(cells, 1 - belongs)
    shares = n * m / (n + m)
    shares /= shares.sum()
    sums = np.bincount(cells, belongs * values), np.bincount(cells, (1 - belongs) * values)
    return float(shares @ (sums[0] / n)), float(shares @ (sums[1] / m))


def _within_shared(
    first: Trials, second: Trials, measure: str
) -> tuple[NDArray[np.int_], Array, Array, Array]:
    """Return four columns of the trials in shared conditions.

    They are a code of the condition, the group (1 or 0), the value, and whether the trial adds
    variance: one whose ``row`` occurs twice does not.
    """
    groups = (first, second)
    values = np.concatenate([_numbers(trials[measure]) for trials in groups])
    belongs = np.repeat([1.0, 0.0], [len(trials["condition"]) for trials in groups])
    rows = [trials.get("row", np.arange(len(trials["condition"]))) for trials in groups]
    kept = ~np.isnan(values)
    cells, names = pd.factorize(np.concatenate([trials["condition"] for trials in groups]))
    for of in (0.0, 1.0):
        kept &= np.bincount(cells[kept & (belongs == of)], minlength=len(names))[cells] > 0
    cells, _ = pd.factorize(cells[kept])
    of_groups = np.split(kept, [len(rows[0])])
    varies = [read_once(np.asarray(row)[of]) for row, of in zip(rows, of_groups, strict=True)]
    return cells, belongs[kept], values[kept], np.concatenate(varies)


def read_once(rows: NDArray[np.int_]) -> NDArray[np.bool_]:
    """Return, for each entry, whether its row number occurs once: the trial is in one cell."""
    return np.asarray(np.bincount(rows)[rows] == 1)


def _numbers(column: pd.Series | Array) -> Array:
    if isinstance(column, np.ndarray):
        return column
    return np.asarray(column.to_numpy(float, na_value=np.nan))


def _freedom(
    cells: NDArray[np.int_],
    belongs: Array,
    group: Array,
    left_over: Array,
    variances: Array,
) -> float:
    """Return the degrees of freedom of an HC2 error by Satterthwaite (1946).

    The squared error is a quadratic form of residuals; ``variances`` are those of the second and
    the first group.
    """
    both = 2 * cells + belongs.astype(int)
    _, at, size = np.unique(both, return_index=True, return_counts=True)
    cell, x, n = cells[at], group[at], size.astype(float)
    variance, factor = variances[belongs[at].astype(int)], group[at] ** 2 / left_over[at]
    trials = np.bincount(cells)[cell]
    fitted = (cell[:, None] == cell) / trials + np.outer(x, x) / float(group @ group)
    # The covariance of residuals of different trials, and what one has beside that with itself.
    apart = (fitted * (n * variance)) @ fitted - fitted * (variance[:, None] + variance)
    residual_variance = variance + np.diag(apart)
    mean = float(n * factor @ residual_variance)
    square = float((n * factor) @ apart**2 @ (n * factor))
    square += float((n * factor**2) @ (residual_variance**2 - np.diag(apart) ** 2))
    return mean**2 / square


def corrected(p: list[float]) -> list[float]:
    """Return p-values by Holm (1979); statsmodels collects garbage for 0.1 s a call."""
    family = np.asarray(p, dtype=float)
    order = np.argsort(family, kind="stable")
    # The smallest is multiplied by the number of tests, the next by one less, and none falls.
    steps = np.maximum.accumulate(family[order] * np.arange(len(family), 0, -1))
    holm = np.empty_like(family)
    holm[order] = np.minimum(steps, 1)
    return [*map(float, holm)]
