"""What a perfect human clone would score: the indicators on resampled human data of a given size.

Each data set draws, per condition, as many human trials as the model has. Before human traces are
imported, outcomes come from the published counts and gaps from the published regression with normal
residuals; afterwards whole trials are resampled. All data sets are fitted at once, since a thousand
fits one by one take minutes; each fit is that of ``regressions``, as a law in the tests says, and
``indicators`` judges them.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from scipy import stats
from scipy.special import expit

from analysis.data.reference_data import HUMAN_GAP_SD_M, human_outcomes, published
from analysis.stats.indicators import PAPER, ROBUST, Criterion
from analysis.stats.regressions import GAP_TERMS, WHO_FIRST_TERMS, gap_design
from merge_runner.scenarios.merge.conditions import HUMAN_CONDITIONS

Array = NDArray[np.float64]

SEED = 260409609
DATA_SETS = 1000
WALD_STEPS = 35  # statsmodels' limit
FIRTH_STEPS = 60
HALVINGS = 8

HEADWAYS = np.array([c.projected_headway_m for c in HUMAN_CONDITIONS.values()])
VELOCITIES = np.array([c.relative_velocity_mps for c in HUMAN_CONDITIONS.values()])
LOGIT_DESIGN = np.column_stack([np.ones(len(HUMAN_CONDITIONS)), HEADWAYS, VELOCITIES])
GAP_DESIGN = gap_design(HEADWAYS, VELOCITIES)

# The degrees of freedom of tests that are no t tests.
NORMAL = np.array(np.inf)

Passes = dict[str, NDArray[np.bool_]]


@dataclass(frozen=True, eq=False)
class Population:
    """Human trials by condition, in the order of HUMAN_CONDITIONS, one array each.

    ``left``: 1 or 0 for who merged first, NaN after a collision. ``gap_m``: NaN after a collision.
    Without traces the last is empty.
    """

    left: tuple[Array, ...]
    gap_m: tuple[Array, ...] = ()


@dataclass(frozen=True, slots=True)
class Ceiling:
    """Shares of human data sets that pass each indicator, and I1 to I4 together (``I1-I4``)."""

    paper: dict[str, float]
    robust: dict[str, float]


@cache
def published_humans() -> Population:
    """The humans as far as they are published: counts, and the regression of their gaps."""
    return Population(left=_by_condition(human_outcomes(), _left(human_outcomes())))


def imported_humans(trials: pd.DataFrame) -> Population:
    """The humans as imported, from rows of ``load_trials``."""
    return Population(
        left=_by_condition(trials, _left(trials)),
        gap_m=_by_condition(trials, trials["gap_m"]),
    )


@cache
def ceiling(humans: Population, sizes: tuple[int, ...]) -> Ceiling:
    """The human ceiling for ``sizes`` trials per condition, in the order of HUMAN_CONDITIONS.

    Without a trial there is nothing to draw, and no share.
    """
    if not sum(sizes):
        return Ceiling({}, {})
    draws = drawn(humans, sizes)
    ols, hc3 = gap_fits(draws)
    return Ceiling(
        _shares(passes(PAPER, logit_fits(draws), ols)),
        _shares(passes(ROBUST, firth_fits(draws), hc3)),
    )


def _shares(passed: Passes) -> dict[str, float]:
    together = np.logical_and.reduce(list(passed.values()))
    return {name: float(each.mean()) for name, each in (passed | {"I1-I4": together}).items()}


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
    sound: NDArray[np.bool_]

    def passes(self, criterion: Criterion) -> NDArray[np.bool_]:
        """In which data sets an indicator holds; where there is no fit it fails."""
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
    """Data sets as sums per condition, arrays of shape (sets, 11).

    ``n`` trials that finished, ``left`` of them merged first on the left; ``gap`` is the sum of
    their gaps in m, ``squared_gap`` that of the squares. The regressions need no more than these.
    """

    n: Array
    left: Array
    gap: Array
    squared_gap: Array


def drawn(humans: Population, sizes: Sequence[int]) -> Draws:
    """DATA_SETS human data sets of ``sizes`` trials, with replacement; some of them collide."""
    rng = np.random.default_rng(SEED)
    n, left, gap, squared_gap = np.zeros((4, DATA_SETS, len(HUMAN_CONDITIONS)))
    expected = GAP_DESIGN @ _published_gap()
    for i, size in enumerate(sizes):
        if size == 0 or len(humans.left[i]) == 0:
            continue
        trials = rng.integers(0, len(humans.left[i]), (DATA_SETS, size))
        who = humans.left[i][trials]
        gap_m = (
            humans.gap_m[i][trials]
            if humans.gap_m
            else expected[i] + HUMAN_GAP_SD_M * rng.standard_normal((DATA_SETS, size))
        )
        finished = np.isfinite(who)
        n[:, i] = finished.sum(axis=1)
        left[:, i] = np.where(finished, who, 0).sum(axis=1)
        gap[:, i] = np.where(finished, gap_m, 0).sum(axis=1)
        squared_gap[:, i] = np.where(finished, gap_m**2, 0).sum(axis=1)
    return Draws(n, left, gap, squared_gap)


def logit_fits(draws: Draws) -> Fits:
    """Who merges first by maximum likelihood (Newton's method), with Wald tests."""
    sets = len(draws.n)
    b, se = np.zeros((sets, 3)), np.zeros((sets, 3))
    alive = _rank(LOGIT_DESIGN, draws.n)
    sound = np.zeros(sets, bool)
    rows = np.flatnonzero(alive)  # a data set that has converged is left as it is
    for _ in range(WALD_STEPS):
        n = draws.n[rows]
        p = expit(b[rows] @ LOGIT_DESIGN.T)
        covariance, regular = _inverse(LOGIT_DESIGN, n * p * (1 - p), alive[rows])
        step = np.einsum("bjk,bk->bj", covariance, (draws.left[rows] - n * p) @ LOGIT_DESIGN)
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
    alive = _rank(LOGIT_DESIGN, draws.n)
    full, b = _firth(draws, alive, (0, 1, 2))
    p = np.ones_like(b)  # the intercept is not tested
    for column in (1, 2):
        constrained, _ = _firth(draws, alive, tuple({0, 1, 2} - {column}))
        p[:, column] = stats.chi2.sf(2 * (full - constrained), 1)
    # Likelihood ratios need no errors.
    return Fits(WHO_FIRST_TERMS, b, np.zeros_like(b), p, NORMAL, alive)


def _firth(draws: Draws, alive: NDArray[np.bool_], free: tuple[int, ...]) -> tuple[Array, Array]:
    """Maximal penalised log-likelihoods (sets,) over ``free`` coefficients, and these (sets, 3).

    Newton steps on Firth's score with the whole design's information, halved where they do not
    increase the penalised likelihood (Heinze and Schemper 2002).
    """
    b, best = np.zeros((len(draws.n), 3)), np.zeros(len(draws.n))
    rows = np.flatnonzero(alive)  # a data set that has converged is left as it is
    best[rows] = _penalised(draws.n[rows], draws.left[rows], b[rows])
    for _ in range(FIRTH_STEPS):
        n, left = draws.n[rows], draws.left[rows]
        step = _firth_step(n, left, b[rows], free)
        for _ in range(HALVINGS):
            tried = _penalised(n, left, b[rows] + step)
            worse = tried < best[rows]
            if not worse.any():
                break
            step[worse] /= 2
        step[tried < best[rows]] = 0
        b[rows] += step
        best[rows] = np.maximum(tried, best[rows])
        rows = rows[np.abs(step).max(axis=1) >= 1e-8]
        if not len(rows):
            break
    return best, b


def _penalised(n: Array, left: Array, b: Array) -> Array:
    """Log-likelihoods of the coefficients ``b`` (sets, 3) with Firth's penalty.

    It is half the logarithm of the determinant of the information: Jeffreys' prior (Firth 1993).
    """
    linear = b @ LOGIT_DESIGN.T
    p = expit(linear)
    determinant = np.linalg.det(_information(LOGIT_DESIGN, n * p * (1 - p)))
    fit = (left * linear - n * np.logaddexp(0, linear)).sum(axis=1)
    return np.asarray(fit + np.log(np.maximum(determinant, 1e-300)) / 2)


def _firth_step(n: Array, left: Array, b: Array, free: tuple[int, ...]) -> Array:
    """A Newton step (sets, 3) of the ``free`` coefficients from ``b``."""
    design, alive = LOGIT_DESIGN, np.ones(len(b), bool)
    p = expit(b @ design.T)
    weights = n * p * (1 - p)
    covariance, _ = _inverse(design, weights, alive)
    # Firth's score adds to each residual the leverage times (1/2 - p): as if each trial were split,
    # and half of its leverage had gone either way (Heinze and Schemper 2002).
    leverage = weights * (covariance.reshape(-1, 9) @ _products(design).T)
    score = (left - n * p + leverage * (0.5 - p)) @ design
    step = np.zeros_like(b)
    step[:, free] = np.einsum(
        "bjk,bk->bj", _inverse(design[:, free], weights, alive)[0], score[:, free]
    )
    # Near separation a Newton step can leave the region where the information is regular.
    return np.clip(step, -5, 5)


def gap_fits(draws: Draws) -> tuple[Fits, Fits]:
    """The gap by least squares, with classical and with HC3 errors."""
    x, n = GAP_DESIGN, draws.n
    alive = _rank(x, n) & (n.sum(axis=1) > x.shape[1])
    inverse, _ = _inverse(x, n, alive)
    b = np.einsum("bjk,bk->bj", inverse, draws.gap @ x)
    fitted = b @ x.T
    # Sums of squares per condition, whose trials share their regressors and so their leverage.
    residual = draws.squared_gap - 2 * fitted * draws.gap + n * fitted**2
    freedom = np.maximum(n.sum(axis=1) - x.shape[1], 1)
    classic = np.einsum("bjj->bj", inverse) * (residual.sum(axis=1) / freedom)[:, None]
    # HC3 divides each residual by 1 - leverage (MacKinnon and White 1985).
    leverage = np.einsum("ij,bjk,ik->bi", x, inverse, x)
    meat = np.einsum("bi,ij,ik->bjk", residual / np.maximum(1 - leverage, 1e-9) ** 2, x, x)
    hc3 = np.einsum("bjk,bkl,blj->bj", inverse, meat, inverse)
    return _gap_fit(b, classic, freedom, alive), _gap_fit(b, hc3, freedom, alive)


def _gap_fit(b: Array, variances: Array, freedom: Array, alive: NDArray[np.bool_]) -> Fits:
    # Where nothing varies, rounding leaves variances just below 0.
    se = np.sqrt(np.maximum(variances, 0))
    with np.errstate(divide="ignore", invalid="ignore"):
        p = 2 * stats.t.sf(np.abs(b / se), freedom[:, None])
    return Fits(GAP_TERMS, b, se, p, freedom, alive)


def _inverse(
    design: Array, weights: Array, alive: NDArray[np.bool_]
) -> tuple[Array, NDArray[np.bool_]]:
    """(X' W X)^-1 for each row of ``weights``, and where it exists; elsewhere the identity."""
    information = _information(design, weights)
    size = design.shape[1]
    sound = alive & (np.linalg.det(information) > 1e-12)
    return np.linalg.inv(np.where(sound[:, None, None], information, np.eye(size))), sound


def _rank(design: Array, n: Array) -> NDArray[np.bool_]:
    """In which data sets the conditions with trials tell all terms apart."""
    information = _information(design, (n > 0).astype(float))
    return np.asarray(np.linalg.matrix_rank(information) == design.shape[1])


def _information(design: Array, weights: Array) -> Array:
    """X' W X for each row of ``weights`` (sets, conditions)."""
    size = design.shape[1]
    return np.asarray((weights @ _products(design)).reshape(-1, size, size))


def _products(design: Array) -> Array:
    """The products of each two regressors, (conditions, regressors squared)."""
    return np.asarray((design[:, :, None] * design[:, None, :]).reshape(len(design), -1))


def _published_gap() -> Array:
    human = published("paper_gap").query("driver == 'human'")
    return np.asarray(human["b"], dtype=float)


def _left(trials: pd.DataFrame) -> pd.Series:
    left = (trials["merged_first"] == "left").astype(float)
    return left.where((trials["status"] == "finished") & trials["merged_first"].notna())


def _by_condition(trials: pd.DataFrame, values: pd.Series) -> tuple[Array, ...]:
    return tuple(values[trials["condition"] == name].to_numpy(float) for name in HUMAN_CONDITIONS)
