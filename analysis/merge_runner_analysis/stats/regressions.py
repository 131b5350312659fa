"""The regressions of arXiv 2604.09609 (eqs. 1 and 2), and robust tests of their coefficients.

A fit that the data do not allow has a ``problem`` in place of terms; only finished trials count.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from itertools import combinations
from math import inf, sqrt
from typing import NamedTuple

import numpy as np
import pandas as pd
import scipy
from numpy.typing import NDArray
from scipy import special

from merge_runner_analysis.stats import intervals
from merge_runner_analysis.wording import Fact, Why

Array = NDArray[np.float64]

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
# A likelihood is at its top if a step gains less than FLAT; after MOST_STEPS there is no estimate.
FLAT, MOST_STEPS, ROUNDING = 1e-9, 100, 1e-11
# Below this logarithm of its determinant the information is singular but for rounding.
SINGULAR = -600.0
# The search for a bound multiplies its step by WIDER, up to FARTHEST standard errors.
WIDER, FARTHEST = 1.3, 1e5
# The search for other maxima starts at the LIKELIEST places, whose log-likelihoods are at most
# UNLIKELY below the first; maxima whose log-likelihoods differ by less than SAME are one.
LIKELIEST, UNLIKELY, SAME = 20, 10.0, 1e-6
SCALES = (0.0, 1.0, 3.0, 10.0)


@dataclass(frozen=True, slots=True)
class Counts:
    """Rows of a ``design`` (rows, terms) with ``n`` trials each, ``chosen`` of them a success."""

    design: Array
    n: Array
    chosen: Array

    def fit(self) -> Fit | None:
        """Return the best fit, or None where none converges."""
        first = self.climb(np.zeros((1, self.design.shape[1])))
        return first and self.climb(first.starts())

    @np.errstate(divide="ignore")
    def climb(self, starts: Array, term: int | None = None, value: float = 0.0) -> Fit | None:
        """Return the best fit that is reached from ``starts``, (starts, terms), if one converges.

        One ``term`` may be held at a value. Newton's steps have the curvature of the penalty, too,
        go uphill where the likelihood is convex (Nocedal and Wright 2006), and are halved until
        they gain.
        """
        b = starts.copy()
        free = np.array([place != term for place in range(b.shape[1])])
        b[:, ~free] = value
        reached = self.penalised(b)
        regular = np.isfinite(reached.likelihood)
        b, reached = b[regular], Penalised(*(part[regular] for part in reached))
        top = np.zeros(len(b), bool)
        for _ in range(MOST_STEPS):
            if top.all():
                break
            bends, directions = np.linalg.eigh(reached.curvature[:, free][:, :, free])
            uphill = (reached.score[:, None, free] @ directions)[:, 0]
            uphill /= np.maximum(np.abs(bends), FLAT)
            step = np.zeros_like(b)
            step[:, free] = (directions @ uphill[:, :, None])[:, :, 0]
            top = (reached.score * step).sum(axis=1) < FLAT
            ahead = self.penalised(b + step)
            while (lower := ahead.likelihood < reached.likelihood - ROUNDING).any():
                step[lower] /= 2
                ahead = self.penalised(b + step)
            b, reached = b + step, ahead
        if not top.any():
            return None
        best = int(np.where(top, reached.likelihood, -inf).argmax())
        return Fit(self, b[best], float(reached.likelihood[best]), reached.information[best])

    def infinite(self) -> NDArray[np.bool_]:
        """Return which coefficients have no finite estimate (Konis 2007)."""
        signed = np.vstack([self.design[self.chosen > 0], -self.design[self.chosen < self.n]])
        solution = scipy.optimize.linprog(
            -signed.sum(axis=0), A_ub=-signed, b_ub=np.zeros(len(signed)), bounds=(-1, 1)
        )
        return np.asarray(np.abs(solution.x) > 1e-4)

    def likelihood(self, b: Array) -> tuple[Array, Array, Array, Array]:
        """Return penalised log-likelihoods at ``b`` (starts, terms), chances, weights, information.

        The penalty is Jeffreys' prior; where the information is singular, it is minus infinity.
        """
        linear = b @ self.design.T
        p = special.expit(linear)
        weights = self.n * p * (1 - p)
        information = (self.design.T * weights[:, None]) @ self.design
        sign, penalty = np.linalg.slogdet(information)
        likelihood = linear @ self.chosen - np.logaddexp(0, linear) @ self.n + penalty / 2
        likelihood[(sign <= 0) | (penalty < SINGULAR)] = -inf
        return likelihood, p, weights, information

    def penalised(self, b: Array) -> Penalised:
        """Return the penalised log-likelihoods at ``b``, (starts, terms), with their derivatives.

        Firth's score adds the leverage times (1/2 - p) to residuals (Heinze and Schemper 2002).
        """
        design = self.design
        likelihood, p, weights, information = self.likelihood(b)
        if (singular := np.isinf(likelihood)).any():
            information[singular] = np.eye(len(design.T))
        weighted = design * np.sqrt(weights)[:, :, None]
        hat = weighted @ np.linalg.inv(information) @ weighted.transpose(0, 2, 1)
        leverage = np.diagonal(hat, axis1=1, axis2=2)
        score = (self.chosen - self.n * p + leverage * (0.5 - p)) @ design
        turned = design * (1 - 2 * p)[:, :, None]  # as the weights change with the linear predictor
        second = (design.T * (leverage * (1 - 6 * p * (1 - p)))[:, None]) @ design
        penalty = (second - turned.transpose(0, 2, 1) @ hat**2 @ turned) / 2
        return Penalised(likelihood, score, information - penalty, information)


class Penalised(NamedTuple):
    """Penalised log-likelihoods (starts,), gradients, curvatures and informations."""

    likelihood: Array
    score: Array
    curvature: Array
    information: Array


@dataclass(frozen=True, slots=True)
class Fit:
    """Coefficients ``b`` (terms,) at the ``best`` penalised log-likelihood."""

    counts: Counts
    b: Array
    best: float
    information: Array

    @property
    def errors(self) -> Array:
        """Wald's standard errors, (terms,)."""
        return np.sqrt(np.diag(np.linalg.inv(self.information)))

    def p(self, term: int) -> float:
        """Return the p-value of the penalised likelihood ratio against a coefficient of 0."""
        without = self.profile(term, 0.0)
        if without is None:
            return np.nan
        return float(special.chdtrc(1, max(0.0, 2 * (self.best - without.best))))

    def profile(self, term: int, value: float) -> Fit | None:
        """Return the best fit with a term held at a value, or None where none converges."""
        return self.counts.climb(self.starts(term, value), term, value)

    def interval(self, term: int, level: float) -> tuple[float, float] | None:
        """Return the interval that the penalised likelihood ratio does not reject."""
        # Half the quantile of chi squared with one degree of freedom.
        lost, error = float(special.gammaincinv(0.5, level)), self.errors[term]
        try:
            low, high = (self._bound(term, lost, width) for width in (-error, error))
        except ValueError:  # there is no bound, or a profile does not converge
            return None
        return low, high

    def _bound(self, term: int, lost: float, width: float) -> float:
        """Return the first value to one side at which the profile loses this log-likelihood.

        A profile followed by steps may miss a higher maximum: it is looked for at the bound. Raises
        ValueError where none is found.
        """
        followed = self.b[None].copy()
        # The last two points of the profile: on the line through them is almost the next.
        path = [self.b - np.linalg.inv(self.information)[term], self.b]

        @cache
        def excess(value: float) -> float:
            before, other = path
            along = other - before
            followed[0] = other + along * (value - other[term]) / along[term]
            profile = self.counts.climb(followed, term, value) or self.profile(term, value)
            if profile is None:
                return np.nan
            if profile.b[term] != other[term]:
                path[:] = other, profile.b
            return float(self.best - profile.best - lost)

        bound, farthest = float(self.b[term]), FARTHEST * abs(width)
        while True:
            inside, outside, step = bound, bound + width, width
            while excess(outside) < 0 and abs(step) < farthest:
                step *= WIDER
                inside, outside = outside, outside + step
            bound = float(scipy.optimize.brentq(excess, inside, outside, xtol=1e-9))
            highest = self.profile(term, bound)
            if highest is None or self.best - highest.best - lost > -SAME:
                return bound
            followed = np.concatenate([followed, highest.b[None]])
            excess.cache_clear()

    @np.errstate(divide="ignore")
    def starts(self, term: int | None = None, value: float = 0.0) -> Array:
        """Return starts that lead to all maxima, perhaps with a term held: (starts, terms).

        With few trials there are several maxima. Some starts give two of the conditions
        a chance of 50 % each, as near to the fit as that allows, measured by its information.
        Others are multiples of the fit (SCALES); at 0 the likelihood is always known.
        """
        fixed = np.eye(len(self.b))[[] if term is None else [term]]
        pairs = self.counts.design[[*combinations(range(len(self.counts.design)), 2)]]
        even = np.concatenate([np.broadcast_to(fixed, (len(pairs), *fixed.shape)), pairs], axis=1)
        values = np.array([value] * len(fixed) + [0.0, 0.0])
        nearest = self._nearest(fixed[None], values[: len(fixed)])
        starts = np.vstack([np.outer(SCALES, nearest), self._nearest(even, values)])
        if term is not None:
            starts[:, term] = value
        likelihood = self.counts.likelihood(starts)[0]
        likeliest = np.argsort(-likelihood)[:LIKELIEST]
        near = likelihood[likeliest] > likelihood.max() - UNLIKELY
        return np.asarray(starts[likeliest[near]])

    def _nearest(self, rows: Array, linear: Array) -> Array:
        """Return the coefficients nearest to the fit with these linear predictors."""
        spread = rows @ np.linalg.inv(self.information)
        # The solution of dependent rows is far off, and unlikely.
        square = spread @ rows.transpose(0, 2, 1) + FLAT * np.eye(len(linear))
        weights = np.linalg.solve(square, (linear - rows @ self.b)[:, :, None])
        return np.asarray(self.b + (weights.transpose(0, 2, 1) @ spread)[:, 0])


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
