"""How many metres of headway weigh as much as one m/s, by the ratio of two slopes.

Standard errors allow the answers of a cluster, a trial's two, to depend on each other. The ratio
has Fieller's interval (Fieller 1954), which has no end where the slope on headway may be 0.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from functools import cache

import numpy as np
import pandas as pd
from scipy import stats
from scipy.special import expit

from analysis.data.first_looks import POINT, FirstLooks
from analysis.data.reference_data import human_outcomes
from analysis.stats.intervals import LEVEL, Estimate
from analysis.stats.regressions import MAX_ITERATIONS, Array

STEADY_MPS2 = 1e-9


@dataclass(frozen=True, slots=True)
class Exchange:
    """Slopes per metre of headway and per m/s of relative velocity, and their exchange rate.

    The rate is minus the second by the first, in m per m/s: as much more headway makes up for
    1 m/s more. Where there is no fit all is None, and ``remark`` says why; where there is one it
    says what to know of it. ``unbounded`` says what the rate's interval is if it has no ends.
    """

    n: int
    headway: Estimate | None = None
    velocity: Estimate | None = None
    rate: float | None = None
    bounds: tuple[float, float] | None = None
    remark: str = ""
    unbounded: str = ""
    intercept: float = 0.0

    def indifferent_m(self, velocity_mps: float) -> float | None:
        """The headway at which a word is as likely as the other, at a relative velocity."""
        if self.headway is None or self.velocity is None or not self.headway.value:
            return None
        return -(self.intercept + (self.velocity.value or 0.0) * velocity_mps) / self.headway.value


def of_words(points: Array, merging: Array, clusters: Array) -> Exchange:
    """From a logit of the word M; points (n, 2) are headways in m and velocities in m/s."""
    if problem := _unidentified(points, clusters):
        return Exchange(len(merging), remark=problem)
    if merging.min() == merging.max():
        return Exchange(
            len(merging), remark=f"{'YM'[int(merging[0])]} in all {len(merging)} answers"
        )
    from firthmodels import detect_separation

    separated = bool(detect_separation(points, merging).separation)
    b = _penalised(points, merging) if separated else _likeliest(points, merging)
    if b is None:
        return Exchange(len(merging), remark="the logistic fit does not converge")
    design = _design(points)
    p: Array = expit(design @ b)
    # Separated answers leave no residuals from which an error could be told.
    errors = (
        _bread(design, p * (1 - p))
        if separated
        else _clustered(design, merging - p, p * (1 - p), clusters)
    )
    remark = "the words are separated: Firth's penalised fit" if separated else ""
    return _exchange(len(merging), b, errors, clusters, remark)


def _likeliest(points: Array, merging: Array) -> Array | None:
    from statsmodels.discrete.discrete_model import Logit

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # that it does not converge, as is checked
        fit = Logit(merging, _design(points)).fit(disp=0)
    return np.asarray(fit.params) if fit.mle_retvals["converged"] else None


def _penalised(points: Array, merging: Array) -> Array | None:
    from firthmodels import FirthLogisticRegression

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # likewise
        fit = FirthLogisticRegression(max_iter=MAX_ITERATIONS).fit(points, merging)
    return np.array([fit.intercept_, *fit.coef_]) if fit.converged_ else None


def of_actions(points: Array, action_mps2: Array, clusters: Array) -> Exchange:
    """From least squares of the first action in m/s^2; points as for ``of_words``."""
    if problem := _unidentified(points, clusters):
        return Exchange(len(points), remark=problem)
    if np.ptp(action_mps2) < STEADY_MPS2:
        return Exchange(len(points), remark="the first actions are all equal")
    design = _design(points)
    b = np.asarray(np.linalg.lstsq(design, action_mps2)[0], dtype=float)
    errors = _clustered(design, action_mps2 - design @ b, np.ones(len(points)), clusters)
    return _exchange(len(points), b, errors, clusters, "")


@cache
def weighed(looks: FirstLooks) -> tuple[Exchange, Exchange]:
    """What weighs in a driver's words, and in its first actions."""
    said, done = looks.words, looks.valid
    merging = (said["tactical"] == "M").to_numpy(float)
    return (
        of_words(said[POINT].to_numpy(float), merging, _trials(said)),
        of_actions(done[POINT].to_numpy(float), done["action_mps2"].to_numpy(float), _trials(done)),
    )


def _trials(rows: pd.DataFrame) -> Array:
    return np.asarray(pd.factorize(rows["trial_id"])[0], dtype=float)


@cache
def of_humans() -> Exchange:
    """From the logit of who merged first in the published human trials: 3.304 / 1.111."""
    trials = human_outcomes().query("status == 'finished'")
    points = trials[["projected_headway_m", "relative_velocity_mps"]].to_numpy(float)
    left = (trials["merged_first"] == "left").to_numpy(float)
    return of_words(points, left, np.arange(len(trials), dtype=float))


def _design(points: Array) -> Array:
    return np.column_stack([np.ones(len(points)), points])


def _unidentified(points: Array, clusters: Array) -> str:
    design = _design(points)
    if (
        len(np.unique(clusters)) <= design.shape[1]
        or np.linalg.matrix_rank(design) < design.shape[1]
        or (np.linalg.qr(design)[0] ** 2).sum(axis=1).max() > 1 - 1e-9  # one answer decides a slope
    ):
        return f"{len(points)} answers, too few or at too few points to tell the slopes apart"
    return ""


def _clustered(design: Array, residuals: Array, weights: Array, clusters: Array) -> Array:
    """The covariance of the coefficients by clusters (Liang and Zeger 1986).

    Each residual is enlarged by its leverage (HC3, MacKinnon and White 1985): without that, planted
    effects are in the intervals of few answers too rarely.
    """
    bread = _bread(design, weights)
    leverage = weights * np.einsum("ij,jk,ik->i", design, bread, design)
    scores = design * (residuals / (1 - leverage))[:, None]
    sums = pd.DataFrame(scores).groupby(clusters).sum().to_numpy()
    return np.asarray(bread @ (sums.T @ sums) @ bread)


def _bread(design: Array, weights: Array) -> Array:
    """The inverse of the information."""
    return np.asarray(np.linalg.inv(design.T @ (design * weights[:, None])))


def _exchange(n: int, b: Array, errors: Array, clusters: Array, remark: str) -> Exchange:
    t = float(stats.t.ppf((1 + LEVEL) / 2, len(np.unique(clusters)) - len(b)))
    slopes = [
        Estimate(float(b[i]), float(b[i] - t * se), float(b[i] + t * se), n)
        for i, se in enumerate(np.sqrt(np.diag(errors)))
    ]
    bounds, unbounded = fieller(b[1:], errors[1:, 1:], t)
    rate = -float(b[2] / b[1]) if b[1] else None
    return Exchange(n, slopes[1], slopes[2], rate, bounds, remark, unbounded, float(b[0]))


def fieller(slopes: Array, errors: Array, t: float) -> tuple[tuple[float, float] | None, str]:
    """The interval of minus the second slope by the first, or in words why it has no ends.

    It holds the rates r at which ``slopes[1] + r * slopes[0]`` is no more than t of its standard
    errors from 0.
    """
    square = slopes[0] ** 2 - t**2 * errors[0, 0]
    half = slopes[0] * slopes[1] - t**2 * errors[0, 1]
    inner = half**2 - square * (slopes[1] ** 2 - t**2 * errors[1, 1])
    if inner <= 0 or square == 0:
        return None, "exchange rate: no value is excluded, its interval has no end"
    ends = sorted(float((-half + sign * np.sqrt(inner)) / square) for sign in (-1, 1))
    if square > 0:
        return (ends[0], ends[1]), ""
    return None, (
        f"exchange rate: only {ends[0]:.2f} to {ends[1]:.2f} is excluded, its interval has no end, "
        "since the slope on headway may be 0"
    )
