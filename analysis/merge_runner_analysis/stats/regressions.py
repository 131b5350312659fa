"""The regressions of arXiv 2604.09609 (eqs. 1 and 2), and robust tests of their coefficients.

A fit that the data do not allow has a ``problem`` in place of terms; only finished trials count.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from math import inf, sqrt

import numpy as np
import pandas as pd
from scipy import special

from merge_runner_analysis.facts import Fact, Why
from merge_runner_analysis.stats import intervals
from merge_runner_analysis.stats.estimate import Array
from merge_runner_analysis.stats.firth import Counts, Fit

WHO_FIRST_TERMS = ("intercept", "projected_headway", "relative_velocity")
GAP_TERMS = (
    "intercept", "abs_projected_headway", "abs_relative_velocity", "headway_x_velocity",
)  # fmt: skip
CONDITION = ["projected_headway_m", "relative_velocity_mps"]
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
    """A fit to ``n`` trials; ``problem`` says why there are no terms, ``remark`` is a caution.

    ``freedom`` is infinite where tests are normal. For gaps, a small ``equivalence_p`` shows that
    relative velocity alone moves them by less than GAP_MARGIN_M: None without two played conditions
    that differ only in it. A small ``velocity_p`` shows that it has an effect: None where errors
    are singular.
    """

    n: int
    terms: dict[str, Term]
    problem: Fact | None = None
    freedom: float = inf
    remark: Fact | None = None
    equivalence_p: float | None = None
    velocity_p: float | None = None
    covariance: Array | None = field(default=None, compare=False)
    profile: Fit | None = field(default=None, compare=False)

    def interval(self, term: str, level: float) -> tuple[float, float] | None:
        """Return the profile interval of a term of Firth's fit, if its profile converges."""
        if self.profile is None:
            return None
        return self.profile.interval([*self.terms].index(term), level)

    def moved(self, conditions: pd.DataFrame) -> Moved | None:
        """Return how far relative velocity alone moves the gap; None without such conditions."""
        headway, velocity = conditions[CONDITION].drop_duplicates().to_numpy(float).T
        design = gap_design(headway, velocity)
        more, less = np.nonzero((headway[:, None] == headway) & (velocity[:, None] > velocity))
        if self.covariance is None or not len(more):
            return None
        apart = design[more] - design[less]
        variances = ((apart @ self.covariance) * apart).sum(axis=1)
        b = np.array([term.b for term in self.terms.values()])
        rank = int(np.linalg.matrix_rank(apart))
        # Rounding leaves variances just below 0 where nothing varies.
        errors = np.sqrt(np.maximum(variances, 0.0))
        return Moved(np.abs(apart @ b), errors, self.freedom, rank)


@dataclass(frozen=True, slots=True)
class Moved:
    """The ``sizes`` of differences of predicted gaps in m, (pairs,), of ``rank`` coefficients."""

    sizes: Array
    errors: Array
    freedom: float
    rank: int

    @property
    def most(self) -> float:
        """The largest difference in m."""
        return float(self.sizes.max())

    def interval(self, level: float) -> tuple[float, float]:
        """Return an interval of the largest difference in m.

        It ends where an intersection-union test does (Berger 1982), as all must be below a bound,
        and begins where one is above in simultaneous intervals (Scheffé 1953).
        """
        together = sqrt(self.rank * float(special.fdtri(self.rank, self.freedom, level)))
        alone = float(special.stdtrit(self.freedom, (1 + level) / 2))
        low = float((self.sizes - together * self.errors).max())
        return max(0.0, low), float((self.sizes + alone * self.errors).max())

    @property
    def within_p(self) -> float:
        """A small p shows that all are below the margin: the largest p of two one-sided tests."""
        pairs = zip(self.sizes.tolist(), self.errors.tolist(), strict=True)
        return max(equivalence_p(size, se, self.freedom) for size, se in pairs)

    @property
    def beyond_p(self) -> float:
        """A small p shows that one is above the margin; the interval of 1 - p begins there."""
        above = self.sizes > GAP_MARGIN_M
        with np.errstate(divide="ignore"):
            ratio = (self.sizes[above] - GAP_MARGIN_M) / self.errors[above]
        p = special.fdtrc(self.rank, self.freedom, ratio**2 / self.rank)
        return float(p.min(initial=1.0))


def who_first_data(trials: pd.DataFrame) -> tuple[Array, Array]:
    """Return the design (n, 3) of intercept, h in m, dv in m/s; and left-first as 0 or 1, (n,)."""
    chosen = trials[(trials["status"] == "finished") & trials["merged_first"].notna()]
    design = np.column_stack([np.ones(len(chosen)), chosen[CONDITION].to_numpy(float)])
    return design, (chosen["merged_first"] == "left").to_numpy(float)


def gap_data(trials: pd.DataFrame, measure: str = "gap_m") -> tuple[Array, Array, pd.DataFrame]:
    """Return the design (n, 4) of intercept, |h|, |dv|, h*dv; gaps in m, (n,); and their trials."""
    chosen = trials[(trials["status"] == "finished") & trials[measure].notna()]
    design = gap_design(*chosen[CONDITION].to_numpy(float).T)
    return design, chosen[measure].to_numpy(float), chosen


def gap_design(headway_m: Array, velocity_mps: Array) -> Array:
    """Return the regressors of the gap: intercept, |h|, |dv| and the signed product h*dv."""
    columns = (np.ones(len(headway_m)), np.abs(headway_m), np.abs(velocity_mps))
    return np.column_stack([*columns, headway_m * velocity_mps])


def equivalence_p(b: float, se: float, freedom: float) -> float:
    """Return the p of |difference| < GAP_MARGIN_M by two one-sided t tests (Schuirmann 1987).

    With a standard error of 0 it is 0 or 1.
    """
    inside = GAP_MARGIN_M - abs(b)
    return float(special.stdtr(freedom, -inside / se)) if se else float(inside <= 0)


def who_first_logit(trials: pd.DataFrame) -> Regression:
    """Fit a logit of left-first on h and dv by maximum likelihood, with Wald tests (eq. 1)."""
    from statsmodels.discrete.discrete_model import Logit

    design, left = who_first_data(trials)
    problem = unfit_for_logit(design, left)
    if problem:
        return Regression(len(left), {}, problem)
    fit = Logit(left, design).fit(disp=0, warn_convergence=False)
    if not fit.mle_retvals["converged"] or not np.isfinite(fit.bse).all():
        return Regression(len(left), {}, Fact(Why.NO_LIKELIHOOD))
    return Regression(len(left), _terms(WHO_FIRST_TERMS, fit.params, fit.bse))


def who_first_firth(trials: pd.DataFrame, less: pd.DataFrame | None = None) -> Regression:
    """Return who goes first by Firth's penalised likelihood (1993), with likelihood ratio tests.

    With ``less``, one model with all interactions fits both samples, and the terms are the
    differences of its coefficients.
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
        return Regression(n, {}, Fact(Why.NO_FIRTH))
    rows = zip(WHO_FIRST_TERMS, fit.b.tolist(), fit.errors.tolist(), tests, strict=False)
    terms = {name: Term(b, se, None, p) for name, b, se, p in rows}
    return Regression(n, terms, profile=fit)


def gap_ols(trials: pd.DataFrame, measure: str = "gap_m", *, robust: bool = False) -> Regression:
    """Fit a gap on |h|, |dv| and h*dv by OLS (eq. 2); ``robust`` errors are HC3."""
    from statsmodels.regression.linear_model import OLS

    design, gap, chosen = gap_data(trials, measure)
    if not np.isfinite(gap).all():
        return Regression(len(gap), {}, Fact(Why.INFINITE_GAP))
    freedom = len(gap) - design.shape[1]
    if freedom < 1 or np.linalg.matrix_rank(design) < design.shape[1]:
        return Regression(len(gap), {}, _too_few(len(gap), Why.NO_GAP, Why.FEW_GAPS))
    if np.ptp(gap) < STEADY_GAP_M:
        return Regression(len(gap), {}, Fact(Why.STEADY_GAP))
    fit = OLS(gap, design).fit()
    if robust:
        if fit.get_influence().hat_matrix_diag.max() > 1 - 1e-9:
            return Regression(len(gap), {}, Fact(Why.ONE_DECIDES))
        fit = fit.get_robustcov_results("HC3", use_t=True)
    covariance = np.asarray(fit.cov_params())
    with_velocity = np.eye(len(GAP_TERMS))[2:]
    told_apart = np.linalg.matrix_rank(covariance[2:, 2:]) == len(with_velocity)
    terms = _terms(GAP_TERMS, fit.params, fit.bse, freedom)
    regression = Regression(len(gap), terms, freedom=freedom, covariance=covariance)
    moved = regression.moved(chosen)
    return replace(
        regression,
        equivalence_p=moved.within_p if moved else None,
        velocity_p=float(fit.f_test(with_velocity).pvalue) if told_apart else None,
    )


def by_pairs(
    fit: Callable[[pd.DataFrame], Regression], trials: pd.DataFrame, measure: str
) -> Regression:
    """Return a fit to those trials that have the measure, with errors clustered by human pair.

    They are a jackknife (CV3 of MacKinnon, Nielsen and Webb 2023), with t on pairs - 1 degrees.
    """
    used = trials[(trials["status"] == "finished") & trials[measure].notna()]
    whole, pairs = fit(used), used["pair"].dropna().unique()
    if len(pairs) < MIN_PAIRS:
        return Regression(whole.n, {}, Fact(Why.FEW_PAIRS, (len(pairs),)))
    parts = {pair: fit(used[used["pair"] != pair]) for pair in pairs}
    lacking = [(pair, part.problem) for pair, part in parts.items() if part.problem]
    if problem := whole.problem or (Fact(Why.WITHOUT_PAIR, lacking[0]) if lacking else None):
        return Regression(whole.n, {}, problem)
    # CV3: the squares of what each pair moves an estimate by, about the whole fit and not the mean.
    b = np.array([[term.b for term in fit.terms.values()] for fit in (whole, *parts.values())])
    freedom = len(pairs) - 1
    apart = b[1:] - b[0]
    covariance = apart.T @ apart * freedom / len(pairs)
    terms = _terms([*whole.terms], b[0], np.sqrt(np.diag(covariance)), freedom)
    remark = Fact(Why.BY_PAIRS, (len(pairs),))
    return Regression(whole.n, terms, freedom=freedom, remark=remark, covariance=covariance)


def _terms(names: Sequence[str], b: Array, se: Array, freedom: float = inf) -> dict[str, Term]:
    terms = {}
    for name, value, error in zip(names, b.tolist(), se.tolist(), strict=True):
        statistic = value / error if error else inf
        terms[name] = Term(value, error, statistic, intervals.two_sided_p(statistic, freedom))
    return terms


def unfit_for_logit(design: Array, left: Array) -> Fact | None:
    """Return why a logit has no finite maximum likelihood estimate, None where it has."""
    problem = _unidentified(design, left)
    if problem or not any(infinite := _cells(design, left).infinite()):
        return problem
    # The intercept comes last, as in the sentence.
    named = np.array([*WHO_FIRST_TERMS[1:], WHO_FIRST_TERMS[0]])[np.roll(infinite, -1)]
    return Fact(Why.SEPARATION, (", ".join(named),))


def _unidentified(design: Array, left: Array) -> Fact | None:
    if len(left) <= design.shape[1] or np.linalg.matrix_rank(design) < design.shape[1]:
        return _too_few(len(left), Why.NO_FIRST, Why.FEW_FIRST)
    if left.min() == left.max():
        return Fact(Why.SAME_FIRST, (len(left),))
    return None


def _cells(design: Array, left: Array) -> Counts:
    cells, place, trials = np.unique(design, axis=0, return_inverse=True, return_counts=True)
    return Counts(cells, trials.astype(float), np.bincount(place, weights=left).astype(float))


def _too_few(n: int, none: Why, few: Why) -> Fact:
    return Fact(few, (n,)) if n else Fact(none)
