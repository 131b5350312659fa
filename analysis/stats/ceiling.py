"""What a perfect human clone would score: the indicators on resampled human data of a given size.

Each data set draws, per condition, as many human trials as the model has. Before human traces are
imported, outcomes come from the published counts and gaps from the published regression with normal
residuals; afterwards whole trials are resampled. All data sets are fitted at once, by the same
definitions as in ``regressions`` and ``indicators``.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from scipy import stats
from scipy.special import expit

from analysis.data.reference_data import HUMAN_GAP_SD_M, human_outcomes, published
from analysis.stats.indicators import ALPHA, SLOPE_MARGIN_S, TESTED
from analysis.stats.regressions import gap_design
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
    """The human ceiling for ``sizes`` trials per condition, in the order of HUMAN_CONDITIONS."""
    draws = _Draws(humans, sizes)
    paper, robust = _wald(draws), _firth_tests(draws)
    paper_gap, robust_gap = _gap_tests(draws)
    both: list[dict[str, float]] = []
    for passes in (paper | paper_gap, robust | robust_gap):
        shares = {name: float(passes[name].mean()) for name in TESTED}
        shares["I1-I4"] = float(np.logical_and.reduce([passes[name] for name in TESTED]).mean())
        both.append(shares)
    return Ceiling(*both)


class _Draws:
    """DATA_SETS human data sets: counts and sums per condition, arrays of shape (sets, 11)."""

    def __init__(self, humans: Population, sizes: Sequence[int]) -> None:
        rng = np.random.default_rng(SEED)
        shape = (DATA_SETS, len(HUMAN_CONDITIONS))
        self.n, self.left = np.zeros(shape), np.zeros(shape)
        self.gap, self.squared_gap = np.zeros(shape), np.zeros(shape)
        expected = GAP_DESIGN @ _published_gap()
        for i, size in enumerate(sizes):
            if size == 0 or len(humans.left[i]) == 0:
                continue
            drawn = rng.integers(0, len(humans.left[i]), (DATA_SETS, size))
            left = humans.left[i][drawn]
            gap = (
                humans.gap_m[i][drawn]
                if humans.gap_m
                else expected[i] + HUMAN_GAP_SD_M * rng.standard_normal((DATA_SETS, size))
            )
            kept = np.isfinite(left)
            self.n[:, i] = kept.sum(axis=1)
            self.left[:, i] = np.where(kept, left, 0).sum(axis=1)
            self.gap[:, i] = np.where(kept, gap, 0).sum(axis=1)
            self.squared_gap[:, i] = np.where(kept, gap**2, 0).sum(axis=1)


def _wald(draws: _Draws) -> Passes:
    """I1 and I2 by Wald tests of the maximum likelihood fit; a fit without an end fails."""
    b, se = np.zeros((DATA_SETS, 3)), np.zeros((DATA_SETS, 3))
    alive = _rank(LOGIT_DESIGN, draws.n)
    sound = np.zeros(DATA_SETS, bool)
    rows = np.flatnonzero(alive)  # a data set that has converged is left as it is
    for _ in range(WALD_STEPS):
        n = draws.n[rows]
        p = expit(b[rows] @ LOGIT_DESIGN.T)
        covariance, regular = _inverse(LOGIT_DESIGN, n * p * (1 - p), alive[rows])
        step = np.einsum("bjk,bk->bj", covariance, (draws.left[rows] - n * p) @ LOGIT_DESIGN)
        b[rows] += np.where(regular[:, None], np.clip(step, -10, 10), 0)
        se[rows] = np.sqrt(np.abs(np.einsum("bjj->bj", covariance)))
        size = np.abs(step).max(axis=1)
        sound[rows] = regular & (size < 1e-6)
        rows = rows[regular & (size >= 1e-10)]
        if not len(rows):
            break
    with np.errstate(divide="ignore", invalid="ignore"):
        significant = 2 * stats.norm.sf(np.abs(b / se)) < ALPHA
    return {
        "I1": sound & significant[:, 1] & (b[:, 1] > 0),
        "I2": sound & significant[:, 2] & (b[:, 2] < 0),
    }


def _firth_tests(draws: _Draws) -> Passes:
    """I1 and I2 by penalised likelihood-ratio tests of Firth's fit."""
    alive = _rank(LOGIT_DESIGN, draws.n)
    full, b = _firth(draws, alive, (0, 1, 2))
    critical = stats.chi2.isf(ALPHA, 1)
    passes = {}
    for name, column, sign in (("I1", 1, 1), ("I2", 2, -1)):
        constrained, _ = _firth(draws, alive, tuple({0, 1, 2} - {column}))
        significant = 2 * (full - constrained) > critical
        passes[name] = alive & significant & (b[:, column] * sign > 0)
    return passes


def _firth(draws: _Draws, alive: NDArray[np.bool_], free: tuple[int, ...]) -> tuple[Array, Array]:
    """Maximal penalised log-likelihoods (sets,) over ``free`` coefficients, and these (sets, 3).

    Newton steps on Firth's score with the whole design's information, halved where they do not
    increase the penalised likelihood (Heinze and Schemper 2002).
    """
    b, best = np.zeros((DATA_SETS, 3)), np.zeros(DATA_SETS)
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
    """Log-likelihoods of the coefficients ``b`` (sets, 3) with Firth's penalty."""
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
    leverage = weights * (covariance.reshape(-1, 9) @ _products(design).T)
    score = (left - n * p + leverage * (0.5 - p)) @ design
    step = np.zeros_like(b)
    step[:, free] = np.einsum(
        "bjk,bk->bj", _inverse(design[:, free], weights, alive)[0], score[:, free]
    )
    return np.clip(step, -5, 5)


def _gap_tests(draws: _Draws) -> tuple[Passes, Passes]:
    """I3 and I4 by the paper's t tests, and by HC3 errors and equivalence."""
    x, n = GAP_DESIGN, draws.n
    alive = _rank(x, n) & (n.sum(axis=1) > x.shape[1])
    inverse, _ = _inverse(x, n, alive)
    b = np.einsum("bjk,bk->bj", inverse, draws.gap @ x)
    fitted = b @ x.T
    residual = draws.squared_gap - 2 * fitted * draws.gap + n * fitted**2  # per condition
    freedom = np.maximum(n.sum(axis=1) - x.shape[1], 1)
    classic = np.einsum("bjj->bj", inverse) * (residual.sum(axis=1) / freedom)[:, None]
    leverage = np.einsum("ij,bjk,ik->bi", x, inverse, x)
    meat = np.einsum("bi,ij,ik->bjk", residual / np.maximum(1 - leverage, 1e-9) ** 2, x, x)
    hc3 = np.einsum("bjk,bkl,blm->bjm", inverse, meat, inverse)
    # Where nothing varies, rounding leaves variances just below 0.
    se = np.sqrt(np.maximum(classic, 0))
    robust_se = np.sqrt(np.maximum(np.einsum("bjj->bj", hc3), 0))
    critical = stats.t.isf(ALPHA / 2, freedom)
    with np.errstate(divide="ignore", invalid="ignore"):
        paper = {
            "I3": alive & (b[:, 1] / se[:, 1] > critical),
            "I4": alive & (np.abs(b[:, 2] / se[:, 2]) <= critical),
        }
        nearest = (SLOPE_MARGIN_S - np.abs(b[:, 2])) / robust_se[:, 2]
        robust = {
            "I3": alive & (b[:, 1] / robust_se[:, 1] > critical),
            "I4": alive & (stats.t.sf(nearest, freedom) < ALPHA),
        }
    return paper, robust


def _inverse(
    design: Array, weights: Array, alive: NDArray[np.bool_]
) -> tuple[Array, NDArray[np.bool_]]:
    """(X' W X)^-1 for each row of ``weights``, and where it exists; elsewhere the identity."""
    information = _information(design, weights)
    size = design.shape[1]
    sound = alive & (np.linalg.det(information) > 1e-12)
    return np.linalg.inv(np.where(sound[:, None, None], information, np.eye(size))), sound


def _rank(design: Array, n: Array) -> NDArray[np.bool_]:
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
