"""Differences between two groups of trials: exact tests, least squares, and corrections."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from itertools import combinations

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from scipy import optimize, special, stats

from merge_runner_analysis.cache import remembered
from merge_runner_analysis.grouping import Group
from merge_runner_analysis.metrics import Metric
from merge_runner_analysis.stats.estimate import Estimate
from merge_runner_analysis.stats.intervals import (
    LEVEL,
    POWER,
    ROUNDING,
    difference,
    melded,
    newcombe,
    tested,
    two_sided_p,
)
from merge_runner_analysis.stats.measures import trials_of, undecided
from merge_runner_analysis.study import Study, in_one_study

# Where less of a trial's deviation is left over than this, it alone decides the difference.
LEVERAGE = 1e-9
# A condition, or a condition and a level of each other factor.
Cell = str | tuple[str, ...]


@dataclass(frozen=True, slots=True)
class Cells:
    """Two rates by condition: successes and trials of the first, and of the second.

    Conditions weigh n m / (n + m), as by Mantel and Haenszel and in least squares.
    """

    a: NDArray[np.int_]
    n: NDArray[np.int_]
    b: NDArray[np.int_]
    m: NDArray[np.int_]

    @property
    def rates(self) -> tuple[tuple[float, float], tuple[float, float]]:
        """Both rates with these weights, each with the trials that it is as good as.

        These are the more, the less of the spread of outcomes lies within conditions. Rates there
        are of both together and of one trial more, of the overall rate: none is 0 or 1 for sure.
        """
        every = self.n + self.m
        weights = self.n * self.m / every
        shares, rates = weights / weights.sum(), (self.a + self.b) / every
        overall = float(shares @ rates)
        within = (self.a + self.b + overall) / (every + 1)
        spread = float(shares @ (within * (1 - within)))
        gain = max(1.0, overall * (1 - overall) / spread) if spread else 1.0
        (one, n), (other, m) = (
            weighted(self.a, self.n, weights),
            weighted(self.b, self.m, weights),
        )
        return (one, gain * n), (other, gain * m)

    @property
    def p(self) -> float:
        """Of Fisher's exact test within conditions, two-sided by probability."""
        chances, least = np.ones(1), 0
        for a, n, b, m in zip(self.a, self.n, self.b, self.m, strict=True):
            there = np.arange(max(0, a + b - m), min(n, a + b) + 1)
            chances = np.convolve(chances, stats.hypergeom.pmf(there, n + m, a + b, n))
            least += there[0]
        # As likely but for rounding is as likely.
        likely = chances <= chances[self.a.sum() - least] * (1 + 1e-7)
        return min(1.0, float(chances[likely].sum() / chances.sum()))


def weighted(
    k: NDArray[np.int_], n: NDArray[np.int_], weights: NDArray[np.float64]
) -> tuple[float, float]:
    """A rate of which conditions have weights, and the trials that it is as good as."""
    shares = weights / weights.sum()
    return float(shares @ (k / n)), 1 / float(shares**2 @ (1 / n))


def shared_cells(first: pd.DataFrame, second: pd.DataFrame, measure: str) -> Cells | None:
    """Return the rates of two groups in the conditions that both have; None where there is none."""
    counts = []
    for frame in (first, second):
        known = frame.loc[frame[measure].notna(), ["condition", measure]]
        hits = known.loc[known[measure].astype(bool), "condition"]
        counts += [Counter(hits), Counter(known["condition"])]
    shared = sorted(counts[1].keys() & counts[3].keys())
    both = (np.array([count[cell] for cell in shared], dtype=int) for count in counts)
    return Cells(*both) if shared else None


def contrast_cells(both: Cells) -> Estimate:
    """Two rates within conditions: Fisher's exact test, and the interval that agrees with it."""
    first, second = both.rates
    found = detectable_rate(int(both.n.sum()), int(both.m.sum()), second[0])
    ends = melded(first, second, both.p)
    return Estimate(first[0] - second[0], *ends, p=both.p, detectable=found)


def difference_of_rates(rates: Sequence[tuple[float, float]]) -> Estimate:
    """Return a difference of rates, (rate, trials) each, with the interval of ``newcombe``.

    Its p is the level at which that interval leaves 0 out.
    """
    low, high = newcombe(rates)
    value = sum(rate for rate, _ in rates[::2]) - sum(rate for rate, _ in rates[1::2])

    def excludes_zero_by(z: float) -> float:
        low, high = newcombe(rates, z)
        return low if value > 0 else -high

    z = 30.0 if value else 0.0  # the largest; of this quantile p is 0 to 190 digits
    if value and excludes_zero_by(z) <= 0:
        z = float(optimize.brentq(excludes_zero_by, 0.0, z))
    return Estimate(value, low, high, p=two_sided_p(z))


def detectable_rate(n: int, m: int, rate: float) -> float | None:
    """The smallest difference from a true ``rate`` that Fisher's test of n and m trials finds.

    In the direction in which less is enough; None where not even rates of 0 and 1 are told apart
    from it with the power.
    """
    found = rejected(n, m) @ stats.binom.pmf(np.arange(m + 1), m, rate)

    def enough(other: float) -> float:
        return float(stats.binom.pmf(np.arange(n + 1), n, other) @ found) - POWER

    ends = [end for end in (0.0, 1.0) if enough(end) >= 0]
    return min((abs(optimize.brentq(enough, rate, end) - rate) for end in ends), default=None)


@cache
def rejected(n: int, m: int) -> NDArray[np.bool_]:
    """Of all outcomes, successes of n by successes of m, those with a Fisher's p below .05."""
    found = np.empty((n + 1, m + 1), dtype=bool)
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
        found[a, total - a] = np.cumsum(p[order])[last] < 1 - LEVEL
    return found


def contrast_means(first: pd.DataFrame, second: pd.DataFrame, measure: str) -> Estimate | None:
    """Two means, compared within the conditions that both have by Welch's test.

    The difference is that of a linear model with a level for each condition, so that another mix of
    conditions, as when one group collides more in some, makes no difference. Its error holds where
    groups differ in size and in variance (HC2; MacKinnon and White 1985), and so do its degrees of
    freedom (Bell and McCaffrey 2002, of two variances). In one condition it is the test of Welch
    (1947). None where the groups share no condition, or a single trial is all of one.
    """
    known = [frame.loc[frame[measure].notna(), ["condition", measure]] for frame in (first, second)]
    shared = {*known[0]["condition"]} & {*known[1]["condition"]}
    if not shared:
        return None
    one, other = (frame[frame["condition"].isin(shared)] for frame in known)
    cells, conditions = pd.factorize(pd.concat([one["condition"], other["condition"]]))
    belongs = np.repeat([1.0, 0.0], [len(one), len(other)])
    values = np.concatenate([one[measure], other[measure]]).astype(float)
    trials = np.bincount(cells)[cells]
    # Of what is left of both within conditions, the slope is that of the whole model (Frisch and
    # Waugh 1933; Lovell 1963).
    group, value = (each - np.bincount(cells, each)[cells] / trials for each in (belongs, values))
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
    return tested(slope, se, freedom)


def _freedom(
    cells: NDArray[np.int_],
    belongs: NDArray[np.float64],
    group: NDArray[np.float64],
    left_over: NDArray[np.float64],
    variances: NDArray[np.float64],
) -> float:
    """The degrees of freedom of an HC2 error of the first group's effect, by Satterthwaite (1946).

    The error is a quadratic form of the residuals, whose mean and variance follow from the
    ``variances`` of the second and the first group. Trials of one group and condition are alike, so
    that only these are compared with each other.
    """
    _, at, size = np.unique(np.column_stack([cells, belongs]), axis=0,
                            return_index=True, return_counts=True)  # fmt: skip
    cell, x, n = cells[at], group[at], size.astype(float)
    variance, each = variances[belongs[at].astype(int)], group[at] ** 2 / left_over[at]
    trials = np.bincount(cells)[cell]
    fitted = (cell[:, None] == cell) / trials + np.outer(x, x) / float(group @ group)
    # The covariance of residuals of different trials, and what one has beside that with itself.
    apart = (fitted * (n * variance)) @ fitted - fitted * (variance[:, None] + variance)
    own = variance + np.diag(apart)
    mean = float(n * each @ own)
    square = float((n * each) @ apart**2 @ (n * each))
    square += float((n * each**2) @ (own**2 - np.diag(apart) ** 2))
    return mean**2 / square


def contrast(
    study: Study, groups: Sequence[Group], metric: Metric, cell: str = "condition"
) -> Estimate | None:
    """The first of two groups minus the second, within the cells that both have.

    Of four groups it is how far the difference of the first two differs from that of the others, in
    the cells that all have. None where these are of several studies, share no cell or none but
    copied ones, or have undecided trials; and for medians, which have no test.
    """
    frames = trials_by_cell(study, groups, metric, cell, shared=len(groups) > 2)
    if metric.estimator == "median" or not frames:
        return None
    pairs = list(zip(frames[::2], frames[1::2], strict=True))
    if not metric.rate:
        one_mean, *other_mean = (contrast_means(*pair, metric.column) for pair in pairs)
        if one_mean is None or not other_mean:
            return one_mean
        return difference(one_mean, other_mean[0]) if other_mean[0] else None
    cells = [found for pair in pairs if (found := shared_cells(*pair, metric.column))]
    if len(cells) < len(pairs):
        return None
    if len(cells) == 1:
        return contrast_cells(cells[0])
    return difference_of_rates([*cells[0].rates, *cells[1].rates[::-1]])


def trials_by_cell(
    study: Study, groups: Sequence[Group], metric: Metric, cell: str, *, shared: bool
) -> list[pd.DataFrame]:
    """The trials of each group with a measure, their cell as ``condition``, perhaps as all have.

    Cells of programs that do not heed what the groups differ in are left out. Nothing where the
    groups are of several studies or have undecided trials.
    """
    if not in_one_study(study, *groups) or any(undecided(group, metric) for group in groups):
        return []
    every = [
        pd.DataFrame({"condition": trials[cell], metric.column: trials[metric.column]}).dropna()
        for trials in (trials_of(group, metric) for group in groups)
    ]
    kept = (set.intersection if shared else set.union)(*(set(one["condition"]) for one in every))
    kept -= copied_cells(study, tuple(groups), cell)
    return [frame[frame["condition"].isin(kept)] for frame in every]


@remembered
def copied_cells(study: Study, groups: tuple[Group, ...], cell: str) -> set[Cell]:
    """The cells of programs that do not heed what the groups differ in.

    With the same other levels, all trials of one of two groups are copies of the other's there, in
    every condition that both have. What they differ by is how often each was drawn, so that nothing
    can be tested. Conditions are never left out one by one: which of them stay would depend on
    what happened there.
    """
    ways = [_ways(study, group, cell) for group in groups]
    copied: set[Cell] = set()
    for one, other in combinations(ways, 2):
        shared = one.keys() & other.keys()
        heeded = {
            _other_levels(each)
            for each in shared
            if not (one[each] <= other[each] or other[each] <= one[each])
        }
        copied |= {each for each in shared if _other_levels(each) not in heeded}
    return copied


@remembered
def _ways(study: Study, group: Group, cell: str) -> dict[Cell, set[object]]:
    """The ways in which the trials of each cell went."""
    ways: dict[Cell, set[object]] = {}
    for name, way in zip(group.ended[cell], group.ended["way"], strict=True):
        ways.setdefault(name, set()).add(way)
    return ways


def _other_levels(cell: Cell) -> Sequence[str]:
    """Those of a cell of factors; a condition alone has none."""
    return () if isinstance(cell, str) else cell[1:]


def copied_of_shared(study: Study, groups: tuple[Group, ...], cell: str) -> tuple[int, int]:
    """How many of the cells that groups share are copied ones, and how many they share."""
    shared = set.intersection(*({*group.ended[cell]} for group in groups))
    return len(shared & copied_cells(study, groups, cell)), len(shared)


def corrected(p: list[float]) -> list[float]:
    """A family's p-values by Holm (1979).

    Not by statsmodels' multipletests, which collects garbage at every call: 0.1 s each, and there
    is a family for every measure of every driver. A test holds both against each other.
    """
    found = np.asarray(p, dtype=float)
    order = np.argsort(found, kind="stable")
    # The smallest is multiplied by the number of tests, the next by one less, and none falls.
    steps = np.maximum.accumulate(found[order] * np.arange(len(found), 0, -1))
    holm = np.empty_like(found)
    holm[order] = np.minimum(steps, 1)
    return [float(value) for value in holm]
