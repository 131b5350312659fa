"""Firth's penalised likelihood of a logit (1993): fits, profiles and their intervals."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from itertools import combinations
from math import inf
from typing import NamedTuple

import numpy as np
import scipy
from numpy.typing import NDArray
from scipy import special

from merge_runner_analysis.stats.estimate import Array

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
