"""Firth's penalised logit of counts by row of a design, and where a logit is separated.

It is finite under separation (Firth 1993; Heinze and Schemper 2002).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import stats
from scipy.optimize import brentq, linprog, minimize
from scipy.special import expit

Array = NDArray[np.float64]

# The largest slope of a likelihood at its top: what is aimed at, and what is still taken for one.
FLAT, SLOPING = 1e-8, 1e-3
# Below this logarithm of its determinant the information is singular but for rounding.
SINGULAR = -600.0
WIDENINGS, WIDER = 40, 1.3


@dataclass(frozen=True, slots=True)
class Counts:
    """Rows of a ``design`` (rows, terms) with ``n`` trials each, ``chosen`` of them a success."""

    design: Array
    n: Array
    chosen: Array

    def fit(
        self, held: Mapping[int, float] | None = None, start: Array | None = None
    ) -> Fit | None:
        """Return the fit with some coefficients ``held``, or None where it does not converge.

        Quasi-Newton steps on Firth's score, since far from the estimate and under separation the
        information misses the curvature of the penalty.
        """
        held = held or {}
        free = [term for term in range(self.design.shape[1]) if term not in held]
        b = np.zeros(self.design.shape[1]) if start is None else start.copy()
        b[[*held]] = [*held.values()]

        origin = b[free]
        try:  # in these units the first step is Newton's
            unit = np.linalg.inv(np.linalg.cholesky(self.information(b)[np.ix_(free, free)])).T
        except np.linalg.LinAlgError:
            return None

        def loss(steps: Array) -> tuple[float, Array]:
            b[free] = origin + unit @ steps
            likelihood, score = self._penalised(b)
            return -likelihood, -unit.T @ score[free]

        start_at = np.zeros(len(free))
        found = minimize(loss, start_at, jac=True, method="BFGS", options={"gtol": FLAT})
        b[free] = origin + unit @ found.x
        flat = np.isfinite(found.fun) and np.abs(found.jac).max(initial=0) < SLOPING
        return Fit(self, b, -float(found.fun)) if flat else None

    def infinite(self) -> NDArray[np.bool_]:
        """Return which coefficients have no finite maximum likelihood estimate, (terms,).

        Separation is a direction in which no row's outcome becomes less likely; the linear program
        of Konis (2007) finds the one that gains most.
        """
        signed = np.vstack([self.design[self.chosen > 0], -self.design[self.chosen < self.n]])
        found = linprog(
            -signed.sum(axis=0), A_ub=-signed, b_ub=np.zeros(len(signed)), bounds=(-1, 1)
        )
        return np.asarray(np.abs(found.x) > 1e-4)

    def information(self, b: Array) -> Array:
        """Return Fisher's information, (terms, terms)."""
        p = expit(self.design @ b)
        return np.asarray((self.design.T * (self.n * p * (1 - p))) @ self.design)

    def _penalised(self, b: Array) -> tuple[float, Array]:
        """Return the log-likelihood of ``b`` with Firth's penalty, and its gradient, (terms,).

        The penalty is half the logarithm of the determinant of the information: Jeffreys' prior.
        Firth's score adds to each residual the leverage times (1/2 - p): as if each trial were
        split, and half of its leverage had gone either way (Heinze and Schemper 2002).
        """
        linear, information = self.design @ b, self.information(b)
        sign, log_determinant = np.linalg.slogdet(information)
        if sign <= 0 or log_determinant < SINGULAR:
            return -np.inf, np.zeros_like(b)
        likelihood = self.chosen @ linear - self.n @ np.logaddexp(0, linear)
        p = expit(linear)
        spread = ((self.design @ np.linalg.inv(information)) * self.design).sum(axis=1)
        leverage = self.n * p * (1 - p) * spread
        score = (self.chosen - self.n * p + leverage * (0.5 - p)) @ self.design
        return float(likelihood + log_determinant / 2), score


@dataclass(frozen=True, slots=True)
class Fit:
    """The coefficients ``b`` (terms,) where the penalised log-likelihood ``best`` is maximal."""

    counts: Counts
    b: Array
    best: float

    @property
    def errors(self) -> Array:
        """Wald's standard errors, (terms,)."""
        return np.sqrt(np.diag(np.linalg.inv(self.counts.information(self.b))))

    def p(self, term: int) -> float:
        """Return the p-value of the penalised likelihood ratio against a coefficient of 0."""
        without = self.counts.fit({term: 0.0})
        return float(stats.chi2.sf(2 * (self.best - without.best), 1)) if without else np.nan

    def interval(self, term: int, level: float) -> tuple[float, float] | None:
        """Return the profile interval: what the penalised likelihood ratio does not reject.

        None where no bound is found.
        """
        lost = stats.chi2.ppf(level, 1) / 2
        near = self.b  # the last profile: far out the other terms are far from the estimate, too
        errors = self.errors
        aside = self.b + errors  # of symmetric data the best profile may lie beside the symmetry

        def excess(value: float) -> float:
            nonlocal near
            fits = [self.counts.fit({term: value}, start) for start in (near, aside)]
            profile = max(filter(None, fits), key=lambda each: each.best, default=None)
            if profile is None:
                return np.nan
            near = profile.b
            return float(self.best - profile.best - lost)

        bounds = []
        for sign in (-1, 1):
            near = self.b
            inside, width = float(self.b[term]), sign * float(errors[term])
            for _ in range(WIDENINGS):
                outside = inside + width
                if not excess(outside) < 0:
                    break
                inside, width = outside, WIDER * width
            if not excess(outside) >= 0:
                return None
            try:
                bounds.append(float(brentq(excess, inside, outside, xtol=1e-9)))
            except ValueError:  # a profile in between does not converge
                return None
        return bounds[0], bounds[1]
