"""The regressions of arXiv 2604.09609 (eqs. 1 and 2), and tests that hold where theirs do not.

A fit that the data do not allow has no terms but a ``problem`` in words. Data frames have the
columns of ``load_trials``; only finished trials count.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import dataclass, field
from math import inf, sqrt

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from scipy import stats

from merge_runner_analysis.stats import firth, intervals

Array = NDArray[np.float64]

WHO_FIRST_TERMS = ("intercept", "projected_headway", "relative_velocity")
GAP_TERMS = (
    "intercept",
    "abs_projected_headway",
    "abs_relative_velocity",
    "headway_x_velocity",
)
MIN_PAIRS = 3  # fewer say nothing of how pairs vary
# Gaps of a program can be equal but for the rounding of a step: that is no effect.
STEADY_GAP_M = 0.01
# Equivalence margin of I4: how far relative velocity alone may move the gap.
GAP_MARGIN_M = 1.0


@dataclass(frozen=True, slots=True)
class Term:
    """One coefficient: estimate, standard error, z or t (None for likelihood ratios), p."""

    b: float
    se: float
    statistic: float | None
    p: float


@dataclass(frozen=True, slots=True)
class Regression:
    """A fit to ``n`` trials; ``problem`` says why there are no terms, and is else empty.

    ``freedom`` is the residual degrees of freedom of a linear fit, infinite where tests are normal;
    ``remark`` is what to know of a fit that has terms. Of a gap alone: ``equivalence_p``, that
    relative velocity alone moves it by less than GAP_MARGIN_M, and ``velocity_p``, that no term
    with relative velocity has an effect (an F test of all of them). These are None where no two
    played conditions differ in relative velocity alone, and where the errors of the terms are not
    two, as without residuals.
    """

    n: int
    terms: dict[str, Term]
    problem: str = ""
    freedom: float = inf
    remark: str = ""
    equivalence_p: float | None = None
    velocity_p: float | None = None
    profile: firth.Fit | None = field(default=None, compare=False)

    def interval(self, term: str) -> tuple[float, float] | None:
        """Return the 95 % interval of a term of Firth's fit, which agrees with its test.

        None where its profile does not converge.
        """
        assert self.profile is not None
        return self.profile.interval([*self.terms].index(term), intervals.LEVEL)


def who_first_data(trials: pd.DataFrame) -> tuple[Array, Array]:
    """Design (n, 3) of intercept, h in m, dv in m/s; and left-first as 0 or 1, shape (n,)."""
    chosen = trials[(trials["status"] == "finished") & trials["merged_first"].notna()]
    design = np.column_stack(
        [
            np.ones(len(chosen)),
            chosen["projected_headway_m"].to_numpy(float),
            chosen["relative_velocity_mps"].to_numpy(float),
        ]
    )
    return design, (chosen["merged_first"] == "left").to_numpy(float)


def gap_data(trials: pd.DataFrame, measure: str = "gap_m") -> tuple[Array, Array, pd.DataFrame]:
    """Design (n, 4) of intercept, |h|, |dv|, h*dv; gaps in m, shape (n,); and their trials."""
    chosen = trials[(trials["status"] == "finished") & trials[measure].notna()]
    return (
        gap_design(
            chosen["projected_headway_m"].to_numpy(float),
            chosen["relative_velocity_mps"].to_numpy(float),
        ),
        chosen[measure].to_numpy(float),
        chosen,
    )


def gap_design(headway_m: Array, velocity_mps: Array) -> Array:
    """The regressors of the gap: intercept, |h|, |dv| and the signed product h*dv."""
    return np.column_stack(
        [
            np.ones(len(headway_m)),
            np.abs(headway_m),
            np.abs(velocity_mps),
            headway_m * velocity_mps,
        ]
    )


def equivalence_p(b: float, se: float, freedom: float) -> float:
    """The p-value of |difference| < GAP_MARGIN_M, by two one-sided t tests (Schuirmann 1987).

    It is the larger of the two, that against the nearer margin. A difference without an error, as
    of a driver without spread, is sure: it lies within the margin or it does not.
    """
    inside = GAP_MARGIN_M - abs(b)
    return float(stats.t.sf(inside / se, freedom)) if se else float(inside <= 0)


def who_first_logit(trials: pd.DataFrame) -> Regression:
    """Logit of left-first on h and dv by maximum likelihood, with Wald tests (eq. 1)."""
    from statsmodels.discrete.discrete_model import Logit
    from statsmodels.tools.sm_exceptions import ConvergenceWarning

    design, left = who_first_data(trials)
    problem = unfit_for_logit(design, left)
    if problem:
        return Regression(len(left), {}, problem)
    with warnings.catch_warnings():
        # Convergence is checked right below.
        warnings.simplefilter("ignore", ConvergenceWarning)
        fit = Logit(left, design).fit(disp=0)
    if not fit.mle_retvals["converged"] or not np.isfinite(fit.bse).all():
        return Regression(len(left), {}, "the maximum likelihood fit does not converge")
    return Regression(
        len(left), _terms(WHO_FIRST_TERMS, fit.params, fit.bse, fit.tvalues, fit.pvalues)
    )


def who_first_firth(trials: pd.DataFrame, less: pd.DataFrame | None = None) -> Regression:
    """The same by Firth's penalised likelihood (1993), which is finite under separation.

    Its tests are penalised likelihood ratios (Heinze and Schemper 2002). With other trials its
    terms are the coefficients ``less`` theirs, of one model of both in which every term may differ.
    """
    design, left = who_first_data(trials)
    n, problem = len(left), _unidentified(design, left)
    if less is not None:
        rest, rest_left = who_first_data(less)
        problem = problem or _unidentified(rest, rest_left)
        design = np.block([[design, design], [0 * rest, rest]])
        left = np.concatenate([left, rest_left])
    if problem:
        return Regression(n, {}, problem)
    fit = _cells(design, left).fit()
    tests = [fit.p(place) for place in range(len(WHO_FIRST_TERMS))] if fit else [np.nan]
    if fit is None or not np.isfinite(tests).all():
        return Regression(n, {}, "Firth's penalised fit does not converge")
    found = zip(WHO_FIRST_TERMS, fit.b, fit.errors, tests, strict=False)
    terms = {name: Term(float(b), float(se), None, p) for name, b, se, p in found}
    return Regression(n, terms, profile=fit)


def gap_ols(trials: pd.DataFrame, measure: str = "gap_m", *, robust: bool = False) -> Regression:
    """OLS of a gap on |h|, |dv| and h*dv (eq. 2); ``robust`` takes HC3 standard errors.

    HC3 holds under unequal variances (MacKinnon and White 1985).
    """
    from statsmodels.regression.linear_model import OLS

    design, gap, chosen = gap_data(trials, measure)
    if not np.isfinite(gap).all():
        return Regression(len(gap), {}, "a gap is not finite")
    freedom = len(gap) - design.shape[1]
    if freedom < 1 or np.linalg.matrix_rank(design) < design.shape[1]:
        return Regression(len(gap), {}, _too_few(len(gap), "with a gap"))
    if np.ptp(gap) < STEADY_GAP_M:
        return Regression(len(gap), {}, "the gaps vary by less than 1 cm: there is nothing to test")
    fit = OLS(gap, design).fit()
    if robust:
        if fit.get_influence().hat_matrix_diag.max() > 1 - 1e-9:
            return Regression(len(gap), {}, "a single trial decides a coefficient: no HC3 errors")
        fit = fit.get_robustcov_results("HC3", use_t=True)
    covariance = np.asarray(fit.cov_params())
    with_velocity = np.eye(len(GAP_TERMS))[2:]
    told_apart = np.linalg.matrix_rank(covariance[2:, 2:]) == len(with_velocity)
    return Regression(
        len(gap),
        _terms(GAP_TERMS, fit.params, fit.bse, fit.tvalues, fit.pvalues),
        freedom=freedom,
        equivalence_p=_velocity_alone(chosen, fit.params, covariance, freedom),
        velocity_p=float(fit.f_test(with_velocity).pvalue) if told_apart else None,
    )


def _velocity_alone(
    trials: pd.DataFrame, b: Array, covariance: Array, freedom: int
) -> float | None:
    """The p-value that relative velocity alone moves no predicted gap by the margin.

    That of an intersection-union test (Berger 1982), the largest over all pairs of played
    conditions that differ in relative velocity alone; None where there is no such pair.
    """
    played = trials[["projected_headway_m", "relative_velocity_mps"]].drop_duplicates()
    headway, velocity = played.to_numpy(float).T
    design = gap_design(headway, velocity)
    more, less = np.nonzero((headway[:, None] == headway) & (velocity[:, None] > velocity))
    tests = [
        # Rounding leaves variances just below 0 where nothing varies.
        equivalence_p(float(row @ b), sqrt(max(float(row @ covariance @ row), 0.0)), freedom)
        for row in design[more] - design[less]
    ]
    return max(tests, default=None)


def by_pairs(
    fit: Callable[[pd.DataFrame], Regression], trials: pd.DataFrame, measure: str
) -> Regression:
    """A fit to those trials that have the measure, with errors clustered by human pair.

    Errors are a jackknife over the pairs (CV3 of MacKinnon, Nielsen and Webb 2023), whose
    correction holds for as few clusters as there are; tests are t on pairs - 1 degrees of freedom.
    """
    used = trials[(trials["status"] == "finished") & trials[measure].notna()]
    whole, pairs = fit(used), used["pair"].dropna().unique()
    if len(pairs) < MIN_PAIRS:
        return Regression(whole.n, {}, f"{len(pairs)} pairs are too few for errors by pair")
    parts = {pair: fit(used[used["pair"] != pair]) for pair in pairs} if whole.terms else {}
    lacking = [f"without {pair}: {part.problem}" for pair, part in parts.items() if part.problem]
    if whole.problem or lacking:
        return Regression(whole.n, {}, whole.problem or lacking[0])
    # CV3: the squares of what each pair moves an estimate by, about the whole fit and not the mean.
    freedom = len(pairs) - 1
    terms = {}
    for name, term in whole.terms.items():
        moved = sum((part.terms[name].b - term.b) ** 2 for part in parts.values())
        se = sqrt(moved * freedom / len(pairs))
        statistic = term.b / se if se else inf
        terms[name] = Term(term.b, se, statistic, intervals.two_sided_p(statistic, freedom))
    remark = f"errors by jackknife over {len(pairs)} pairs"
    return Regression(whole.n, terms, freedom=freedom, remark=remark)


def _terms(names: tuple[str, ...], *columns: Array) -> dict[str, Term]:
    """The terms from columns of estimates, errors, statistics and p."""
    rows = np.column_stack(columns).tolist()
    return {name: Term(*row) for name, row in zip(names, rows, strict=True)}


def unfit_for_logit(design: Array, left: Array) -> str:
    """Why a logit has no finite maximum likelihood estimate, empty where it has."""
    return _unidentified(design, left) or _separated(design, left)


def _unidentified(design: Array, left: Array) -> str:
    if len(left) <= design.shape[1] or np.linalg.matrix_rank(design) < design.shape[1]:
        return _too_few(len(left), "with a first merger")
    if left.min() == left.max():
        return f"who merged first is the same in all {len(left)} trials: nothing to explain"
    return ""


def _separated(design: Array, left: Array) -> str:
    infinite = _cells(design, left).infinite()
    if not infinite.any():
        return ""
    # The level comes last, as it is said.
    named = np.array([*WHO_FIRST_TERMS[1:], WHO_FIRST_TERMS[0]])[np.roll(infinite, -1)]
    return f"separation: no finite estimate of {', '.join(named)}; see Firth's fit"


def _cells(design: Array, left: Array) -> firth.Counts:
    """Trials of equal regressors as one binomial."""
    cells, place, trials = np.unique(design, axis=0, return_inverse=True, return_counts=True)
    return firth.Counts(cells, trials.astype(float), np.bincount(place, weights=left).astype(float))


def _too_few(n: int, what: str) -> str:
    if n == 0:
        return f"no finished trial {what}"
    trials = "trial" if n == 1 else "trials"
    return f"{n} finished {trials} {what}, too few or in too few conditions to tell the terms apart"
