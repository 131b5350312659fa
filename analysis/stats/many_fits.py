"""The regressions of many data sets at once, since thousands of fits one by one take minutes.

Each fit is that of ``regressions``, as laws in the tests say.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy import stats
from scipy.special import expit

from merge_runner.scenarios.merge.conditions import HUMAN_CONDITIONS
from merge_runner_analysis.stats import firth
from merge_runner_analysis.stats.indicators import APART, Criterion
from merge_runner_analysis.stats.regressions import (
    GAP_TERMS,
    WHO_FIRST_TERMS,
    gap_design,
    velocity_contrasts,
)

Array = NDArray[np.float64]
Holds = NDArray[np.bool_]

WALD_STEPS = 35  # statsmodels' limit

HEADWAYS = np.array([c.projected_headway_m for c in HUMAN_CONDITIONS.values()])
VELOCITIES = np.array([c.relative_velocity_mps for c in HUMAN_CONDITIONS.values()])

Passes = dict[str, Holds]

# The degrees of freedom of tests that are no t tests.
NORMAL = np.array(np.inf)


@dataclass(frozen=True, eq=False)
class Apart:
    """``Regression.apart`` of each data set: arrays of shape (sets, differences).

    ``played`` is False where a data set lacks one of the two conditions.
    """

    b: Array
    se: Array
    played: Holds


@dataclass(frozen=True, eq=False)
class Fits:
    """One regression of each data set: arrays of shape (sets, terms).

    ``freedom`` is that of t tests, infinite where they are none; ``sound`` is False where there is
    no estimate, whatever stands in the others there. Both are of shape (sets,).
    """

    terms: tuple[str, ...]
    b: Array
    se: Array
    p: Array
    freedom: Array
    sound: Holds
    apart: Apart | None = None

    def passes(self, criterion: Criterion) -> Holds:
        """In which data sets an indicator holds; where there is no fit it fails."""
        if criterion.term == APART:
            assert self.apart is not None
            b, se, played = self.apart.b, self.apart.se, self.apart.played
            each = criterion.holds(b, se, np.ones_like(b), self.freedom[:, None])
            return self.sound & played.any(axis=1) & (each | ~played).all(axis=1)
        at = self.terms.index(criterion.term)
        # An error is 0 where no residual is left: what is divided by it is judged right as well.
        with np.errstate(divide="ignore", invalid="ignore"):
            holds = criterion.holds(self.b[:, at], self.se[:, at], self.p[:, at], self.freedom)
        return self.sound & holds


def passes(criteria: Mapping[str, Criterion], who_first: Fits, gap: Fits) -> Passes:
    """In which data sets each indicator holds."""
    return {
        name: (who_first if criterion.of_who_first else gap).passes(criterion)
        for name, criterion in criteria.items()
    }


@dataclass(frozen=True, eq=False)
class Draws:
    """Data sets as sums per condition, arrays of shape (sets, conditions).

    ``n`` trials that finished, ``left`` of them merged first on the left; ``gap`` is the sum of
    their gaps in m, ``squared_gap`` that of the squares. The regressions need no more than these.
    The conditions are those of the humans unless their ``headways_m`` and ``velocities_mps`` are
    given.
    """

    n: Array
    left: Array
    gap: Array
    squared_gap: Array
    headways_m: Array = field(default_factory=HEADWAYS.copy)
    velocities_mps: Array = field(default_factory=VELOCITIES.copy)

    @property
    def logit_design(self) -> Array:
        """The regressors of who merges first, (conditions, 3)."""
        return np.column_stack(
            [np.ones(len(self.headways_m)), self.headways_m, self.velocities_mps]
        )

    @property
    def gap_design(self) -> Array:
        """The regressors of the gap, (conditions, 4)."""
        return gap_design(self.headways_m, self.velocities_mps)


def logit_fits(draws: Draws) -> Fits:
    """Who merges first by maximum likelihood (Newton's method), with Wald tests."""
    design, sets = draws.logit_design, len(draws.n)
    b, se = np.zeros((sets, 3)), np.zeros((sets, 3))
    alive = firth.identified(design, draws.n)
    sound = np.zeros(sets, bool)
    rows = np.flatnonzero(alive)  # a data set that has converged is left as it is
    for _ in range(WALD_STEPS):
        n = draws.n[rows]
        p = expit(b[rows] @ design.T)
        covariance, regular = firth.inverse(design, n * p * (1 - p), alive[rows])
        step = np.einsum("bjk,bk->bj", covariance, (draws.left[rows] - n * p) @ design)
        # Under separation the steps never end; clipped, they overflow nothing until they are cut.
        b[rows] += np.where(regular[:, None], np.clip(step, -10, 10), 0)
        se[rows] = np.sqrt(np.abs(np.einsum("bjj->bj", covariance)))
        size = np.abs(step).max(axis=1)
        sound[rows] = regular & (size < 1e-6)
        rows = rows[regular & (size >= 1e-10)]
        if not len(rows):
            break
    with np.errstate(divide="ignore", invalid="ignore"):
        p = 2 * stats.norm.sf(np.abs(b / se))
    return Fits(WHO_FIRST_TERMS, b, se, p, NORMAL, sound)


def firth_fits(draws: Draws) -> Fits:
    """Who merges first by Firth's fit, with penalised likelihood-ratio tests of the slopes."""
    b, p, alive = firth.tested_fits(draws.logit_design, draws.n, draws.left, (1, 2))
    # Likelihood ratios need no errors.
    return Fits(WHO_FIRST_TERMS, b, np.zeros_like(b), p, NORMAL, alive)


def firth_differences(draws: Draws, others: Draws, term: str) -> Fits:
    """By term how the coefficients of two groups differ, first minus second.

    Of one model of both in which every term may differ between them, with a penalised
    likelihood-ratio test of one term's difference.
    """
    own, rest = draws.logit_design, others.logit_design
    design = np.block([[rest, 0 * rest], [own, own]])
    n, left = (np.hstack(pair) for pair in ((others.n, draws.n), (others.left, draws.left)))
    at = 3 + WHO_FIRST_TERMS.index(term)
    b, p, alive = firth.tested_fits(design, n, left, (at,))
    return Fits(WHO_FIRST_TERMS, b[:, 3:], np.zeros_like(b[:, 3:]), p[:, 3:], NORMAL, alive)


def gap_fits(draws: Draws) -> tuple[Fits, Fits]:
    """The gap by least squares, with classical and with HC3 errors."""
    x, n = draws.gap_design, draws.n
    alive = firth.identified(x, n) & (n.sum(axis=1) > x.shape[1])
    inverse, _ = firth.inverse(x, n, alive)
    b = np.einsum("bjk,bk->bj", inverse, draws.gap @ x)
    fitted = b @ x.T
    # Sums of squares per condition, whose trials share their regressors and so their leverage.
    residual = draws.squared_gap - 2 * fitted * draws.gap + n * fitted**2
    freedom = np.maximum(n.sum(axis=1) - x.shape[1], 1)
    classic = inverse * (residual.sum(axis=1) / freedom)[:, None, None]
    # HC3 divides each residual by 1 - leverage (MacKinnon and White 1985).
    leverage = np.einsum("ij,bjk,ik->bi", x, inverse, x)
    meat = np.einsum("bi,ij,ik->bjk", residual / np.maximum(1 - leverage, 1e-9) ** 2, x, x)
    hc3 = inverse @ meat @ inverse
    return _gap_fit(draws, b, classic, freedom, alive), _gap_fit(draws, b, hc3, freedom, alive)


def mean_gap_differences(draws: Draws, others: Draws) -> tuple[Array, Array]:
    """Mean gaps of two groups in m, first minus second within conditions, and their p, (sets,).

    By Student's t of the linear model of ``contrasts.contrast_means``. Infinite errors, and a p of
    1, where the groups share no condition.
    """
    n, m = draws.n, others.n
    both = np.maximum(n + m, 1)
    apart = draws.gap / np.maximum(n, 1) - others.gap / np.maximum(m, 1)
    weight = n * m / both
    total = weight.sum(axis=1)
    difference = (weight * apart).sum(axis=1) / np.maximum(total, 1e-12)
    within = draws.squared_gap + others.squared_gap - (draws.gap + others.gap) ** 2 / both
    freedom = np.maximum((n + m).sum(axis=1) - (n + m > 0).sum(axis=1) - 1, 1)
    left_over = np.maximum(within.sum(axis=1) - difference**2 * total, 0)
    with np.errstate(divide="ignore", invalid="ignore"):
        se = np.sqrt(left_over / freedom / total)
        p = np.where(total > 0, 2 * stats.t.sf(np.abs(difference / se), freedom), 1.0)
    return difference, p


def _gap_fit(draws: Draws, b: Array, covariance: Array, freedom: Array, alive: Holds) -> Fits:
    more, less, contrasts = velocity_contrasts(draws.headways_m, draws.velocities_mps)
    # Where nothing varies, rounding leaves variances just below 0.
    se, apart_se = (
        np.sqrt(np.maximum(np.einsum("cj,bjk,ck->bc", rows, covariance, rows), 0))
        for rows in (np.eye(len(GAP_TERMS)), contrasts)
    )
    with np.errstate(divide="ignore", invalid="ignore"):
        p = 2 * stats.t.sf(np.abs(b / se), freedom[:, None])
    played = (draws.n[:, more] > 0) & (draws.n[:, less] > 0)
    apart = Apart(b @ contrasts.T, apart_se, played)
    return Fits(GAP_TERMS, b, se, p, freedom, alive, apart)
