"""Differences between two groups of trials within cells: rates, means, and their corrections."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from functools import cache
from math import hypot, sqrt

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from scipy import optimize, special, stats

from merge_runner_analysis.stats.estimate import Estimate
from merge_runner_analysis.stats.intervals import LEVEL, POWER, ROUNDING, tested, two_sided_p
from merge_runner_analysis.stats.score_interval import Z

# Where less of a trial's deviation is left over than this, it alone decides the difference.
LEVERAGE = 1e-9
NEAREST = 1e-9  # to a difference, of what it may be instead
LARGEST_Z = 30.0  # of this quantile p is 0 to 190 digits
Z_WITH_POWER = Z + float(stats.norm.ppf(POWER))


@dataclass(frozen=True, slots=True)
class Cells:
    """Two rates by cell: successes and trials of the first, and of the second.

    Their difference is that of Mantel and Haenszel: cells weigh n m / (n + m), as in least squares.
    ``varying`` is by cell what share of the trials of either vary by themselves: not those that
    stand in two cells with opposite outcomes, so that their sum is sure.
    """

    a: NDArray[np.int_]
    n: NDArray[np.int_]
    b: NDArray[np.int_]
    m: NDArray[np.int_]
    varying: tuple[NDArray[np.float64] | float, NDArray[np.float64] | float] = (1.0, 1.0)

    @property
    def shares(self) -> NDArray[np.float64]:
        """Weight of each cell, of 1; a trial that stands in two cells counts half in each."""
        n, m = (
            (1 + of) / 2 * size for of, size in zip(self.varying, (self.n, self.m), strict=True)
        )
        weights = n * m / (n + m)
        return np.asarray(weights / weights.sum(), dtype=float)

    @property
    def rates(self) -> tuple[float, float]:
        """Both rates, of cells that weigh as in their difference."""
        return float(self.shares @ (self.a / self.n)), float(self.shares @ (self.b / self.m))

    @property
    def difference(self) -> float:
        """The first rate less the second."""
        return float(self.shares @ (self.a / self.n - self.b / self.m))

    def variance(self, apart: float) -> float:
        """Return that of the difference if the rates of every cell are so far apart.

        As Miettinen and Nurminen (1985) have it: of the likeliest such rates, and unbiased however
        few trials a cell has. Where both rates are equal the test is that of Mantel and Haenszel.
        """
        n, m = self.n, self.m
        p, q = _likeliest(self.a, n, self.b, m, apart)
        every = n + m
        first_varying, second_varying = self.varying
        of_cells = (first_varying * p * (1 - p) / n + second_varying * q * (1 - q) / m) * every
        of_cells = of_cells / (every - 1)
        return float(self.shares**2 @ of_cells)

    def end(self, sign: int, z: float = Z) -> float:
        """Return the lower end (-1) or the upper one (1) of the score interval at a quantile.

        Beyond it are the differences that are ``z`` of their standard errors from the observed one.
        """
        value = self.difference

        def beyond(apart: float) -> float:
            return sign * (apart - value) - z * sqrt(self.variance(apart))

        far, near = float(sign), value + sign * NEAREST
        if sign * near >= 1 or beyond(far) <= 0:
            return far
        # The test of no difference says on which side of 0 the end lies.
        if sign * value < 0 and sign * near < 0:
            far, near = (0.0, near) if beyond(0.0) > 0 else (far, 0.0)
        return near if beyond(near) >= 0 else float(optimize.brentq(beyond, near, far))

    @property
    def p(self) -> float:
        """The p-value of Fisher's exact test within cells, two-sided by probability."""
        chances, least = np.ones(1), 0
        for a, n, b, m in zip(self.a, self.n, self.b, self.m, strict=True):
            possible = np.arange(max(0, a + b - m), min(n, a + b) + 1)
            chances = np.convolve(chances, stats.hypergeom.pmf(possible, n + m, a + b, n))
            least += possible[0]
        # As likely but for rounding is as likely.
        likely = chances <= chances[self.a.sum() - least] * (1 + 1e-7)
        return min(1.0, float(chances[likely].sum() / chances.sum()))


def _likeliest(
    a: NDArray[np.int_], n: NDArray[np.int_], b: NDArray[np.int_], m: NDArray[np.int_], apart: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the likeliest rates that are so far apart (Miettinen and Nurminen 1985).

    The second is a root of a cubic, which their appendix gives in closed form.
    """
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


def weighted(
    k: NDArray[np.int_], n: NDArray[np.int_], weights: NDArray[np.float64]
) -> tuple[float, float]:
    """Return a rate of which conditions have weights, and the trials that it is as good as."""
    shares = weights / weights.sum()
    return float(shares @ (k / n)), 1 / float(shares**2 @ (1 / n))


def shared_cells(first: pd.DataFrame, second: pd.DataFrame, measure: str) -> Cells | None:
    """Return the rates of two groups in the conditions that both have; None where there is none.

    A column ``varies`` says which trials vary by themselves (see ``Cells``); else all do.
    """
    counts = []
    for frame in (first, second):
        known = frame.loc[frame[measure].notna()]
        cells, hits = known["condition"], known[measure].astype(bool)
        varying = cells[known["varies"]] if "varies" in known else cells
        counts += [Counter(cells[hits]), Counter(cells), Counter(varying)]
    shared = sorted(counts[1].keys() & counts[4].keys())
    if not shared:
        return None
    a, n, first_varying, b, m, second_varying = (
        np.array([count[cell] for cell in shared], dtype=int) for count in counts
    )
    return Cells(a, n, b, m, (first_varying / n, second_varying / m))


def contrast_rates(cells: Cells) -> Estimate:
    """Compare two rates within cells: Mantel and Haenszel's test (1959), with a score interval.

    The interval has the differences that the test of Miettinen and Nurminen (1985) does not reject.
    ``detectable`` is the one that is so many standard errors from 0 as it takes for the power. None
    where not even rates of 0 and 1 would differ.
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
    def missing(size: float) -> float:
        return Z_WITH_POWER * sqrt(cells.variance(sign * size)) - size

    return None if missing(NEAREST) <= 0 else float(optimize.brentq(missing, NEAREST, 1.0))


def difference_of_contrasts(cells: Cells, others: Cells) -> Estimate:
    """Return the difference of two differences of rates: an interaction.

    Its interval follows from those of both (MOVER; Zou and Donner 2008), and p is the level at
    which that leaves 0 out.
    """
    differences = cells.difference, others.difference
    value = differences[0] - differences[1]

    def half(sign: int, z: float) -> float:
        apart = (cells.end(sign, z) - differences[0], others.end(-sign, z) - differences[1])
        return hypot(*apart)

    def left_out(z: float) -> float:
        return abs(value) - half(-1 if value > 0 else 1, z)

    z = LARGEST_Z if abs(value) > ROUNDING else 0.0
    if z and left_out(z) <= 0:
        z = float(optimize.brentq(left_out, 0.0, z))
    below, above = half(-1, Z), half(1, Z)
    least = Z_WITH_POWER / Z * min(below, above)
    ends = value - below, value + above
    return Estimate(value, *ends, se=least / Z_WITH_POWER, p=two_sided_p(z), detectable=least)


def detectable_rate(n: int, m: int, rate: float) -> float | None:
    """Return the minimum detectable effect of Fisher's test of n and m trials at a true ``rate``.

    In the direction in which less is enough; None where not even rates of 0 and 1 differ from it
    with the power.
    """
    chances = rejected(n, m) @ stats.binom.pmf(np.arange(m + 1), m, rate)

    def enough(other: float) -> float:
        return float(stats.binom.pmf(np.arange(n + 1), n, other) @ chances) - POWER

    ends = [end for end in (0.0, 1.0) if enough(end) >= 0]
    return min((abs(optimize.brentq(enough, rate, end) - rate) for end in ends), default=None)


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


def contrast_means(first: pd.DataFrame, second: pd.DataFrame, measure: str) -> Estimate | None:
    """Compare two means within the conditions that both have, by Welch's test.

    The difference is that of a linear model with a level for each condition, so that another mix of
    conditions, as when one group collides more in some, makes no difference. Its error holds where
    groups differ in size and in variance (HC2; MacKinnon and White 1985), and so do its degrees of
    freedom (Bell and McCaffrey 2002, of two variances). In one condition it is the test of Welch
    (1947). None where the groups share no condition, or a single trial is all of one; without a
    test where all trials of a condition are equal.
    """
    known = [frame.loc[frame[measure].notna(), ["condition", measure]] for frame in (first, second)]
    shared = {*known[0]["condition"]} & {*known[1]["condition"]}
    if not shared:
        return None
    first_rows, second_rows = (frame[frame["condition"].isin(shared)] for frame in known)
    cells, conditions = pd.factorize(pd.concat([first_rows["condition"], second_rows["condition"]]))
    belongs = np.repeat([1.0, 0.0], [len(first_rows), len(second_rows)])
    values = np.concatenate([first_rows[measure], second_rows[measure]]).astype(float)
    trials = np.bincount(cells)[cells]
    # The slope of the residuals within conditions is that of the whole model (Frisch and Waugh
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
    freedom = float(len(cells) - len(conditions) - 1)
    if se > ROUNDING:
        freedom = _freedom(cells, belongs, group, left_over, np.array(variances))
    elif abs(slope) < ROUNDING:
        return Estimate(0.0, se=0.0, freedom=freedom)
    return tested(slope, se, freedom)


def means_within(first: pd.DataFrame, second: pd.DataFrame, measure: str) -> tuple[float, float]:
    """Return both means, of the conditions that both have, which weigh as in their difference."""
    frames = first.loc[first[measure].notna()], second.loc[second[measure].notna()]
    cells, conditions = pd.factorize(pd.concat([frame["condition"] for frame in frames]))
    size, counts, sums = len(frames[0]), [], []
    for codes, frame in zip((cells[:size], cells[size:]), frames, strict=True):
        values = frame[measure].to_numpy(float)
        counts.append(np.bincount(codes, minlength=len(conditions)))
        sums.append(np.bincount(codes, values, minlength=len(conditions)))
    shared = (counts[0] > 0) & (counts[1] > 0)
    (n, m), (first_sum, second_sum) = ([part[shared] for part in parts] for parts in (counts, sums))
    shares = n * m / (n + m)
    shares /= shares.sum()
    return float(shares @ (first_sum / n)), float(shares @ (second_sum / m))


def _freedom(
    cells: NDArray[np.int_],
    belongs: NDArray[np.float64],
    group: NDArray[np.float64],
    left_over: NDArray[np.float64],
    variances: NDArray[np.float64],
) -> float:
    """Return the degrees of freedom of an HC2 error by Satterthwaite (1946).

    The error is a quadratic form of the residuals, whose mean and variance follow from the
    ``variances`` of the second and the first group. Trials of one group and condition are alike, so
    that only these are compared with each other.
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
    """Return a family's p-values by Holm (1979).

    Not by statsmodels' multipletests, which collects garbage at every call: 0.1 s each, and there
    is a family for every measure of every driver. A test holds both against each other.
    """
    family = np.asarray(p, dtype=float)
    order = np.argsort(family, kind="stable")
    # The smallest is multiplied by the number of tests, the next by one less, and none falls.
    steps = np.maximum.accumulate(family[order] * np.arange(len(family), 0, -1))
    holm = np.empty_like(family)
    holm[order] = np.minimum(steps, 1)
    return [*map(float, holm)]
