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

STEPS = 60
HALVINGS = 8
# Near separation a Newton step can leave the region where the information is regular.
LONGEST_STEP = 5.0
CONVERGED = 1e-8
# Of a log-likelihood: what is smaller than this is no loss.
ROUNDING = 1e-11
WIDENINGS, WIDER = 40, 1.3
# The largest slope of a likelihood at its top: what is aimed at, and what is still taken for one.
FLAT, SLOPING = 1e-7, 1e-3


@dataclass(frozen=True, slots=True)
class Fit:
    """The coefficients ``b`` (terms,) where the penalised log-likelihood ``best`` is maximal."""

    b: Array
    best: float


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

        Newton steps on Firth's score with the whole design's information, halved where they do not
        increase the penalised likelihood (Heinze and Schemper 2002).
        """
        held = held or {}
        free = [term for term in range(self.design.shape[1]) if term not in held]
        b = np.zeros(self.design.shape[1]) if start is None else start.copy()
        b[[*held]] = [*held.values()]
        best = self._penalised(b)
        for _ in range(STEPS):
            try:
                step = self._step(b, free)
            except np.linalg.LinAlgError:
                return None
            for _ in range(HALVINGS):
                reached = self._penalised(b + step)
                if reached >= best - ROUNDING:
                    b, best = b + step, max(reached, best)
                    break
                step /= 2
            else:
                return Fit(b, best)  # no direction is uphill but for rounding
            if np.abs(step).max(initial=0) < CONVERGED:
                return Fit(b, best)
        # Of a profile the likelihood alone counts, which the last small steps hardly change.
        return self._climbed(b, free) or (Fit(b, best) if held else None)

    def _climbed(self, b: Array, free: list[int]) -> Fit | None:
        """Return the fit by quasi-Newton steps, for where the information misses the curvature.

        That is so far from the estimate, and where data are separated.
        """

        def placed(values: Array) -> Array:
            whole = b.copy()
            whole[free] = values
            return whole

        try:
            found = minimize(
                lambda values: -self._penalised(placed(values)),
                b[free],
                jac=lambda values: -self._score(placed(values))[free],
                method="BFGS",
                options={"gtol": FLAT},
            )
        except np.linalg.LinAlgError:
            return None
        flat = np.abs(found.jac).max(initial=0) < SLOPING
        return Fit(placed(found.x), -float(found.fun)) if flat else None

    def p(self, fit: Fit, term: int) -> float | None:
        """Return the p-value of the penalised likelihood ratio against a coefficient of 0."""
        without = self.fit({term: 0.0})
        return None if without is None else float(stats.chi2.sf(2 * (fit.best - without.best), 1))

    def errors(self, fit: Fit) -> Array:
        """Return Wald's standard errors, (terms,)."""
        p = expit(self.design @ fit.b)
        return np.sqrt(np.diag(np.linalg.inv(self._information(self.n * p * (1 - p)))))

    def interval(self, fit: Fit, term: int, level: float) -> tuple[float, float] | None:
        """Return the profile interval: what the penalised likelihood ratio does not reject.

        None where no bound is found.
        """
        lost = stats.chi2.ppf(level, 1) / 2
        near = fit.b  # the last profile: far out the other terms are far from the estimate, too

        def excess(value: float) -> float:
            nonlocal near
            fits = [self.fit({term: value}, start) for start in (near, fit.b)]
            profile = max(filter(None, fits), key=lambda each: each.best, default=None)
            if profile is None:
                return np.nan
            near = profile.b
            return float(fit.best - profile.best - lost)

        bounds = []
        for sign in (-1, 1):
            near = fit.b
            inside, width = float(fit.b[term]), sign * float(self.errors(fit)[term])
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

    def _information(self, weights: Array) -> Array:
        return np.asarray((self.design.T * weights) @ self.design)

    def _penalised(self, b: Array) -> float:
        """Return the log-likelihood of ``b`` with Firth's penalty.

        It is half the logarithm of the determinant of the information: Jeffreys' prior.
        """
        linear = self.design @ b
        p = expit(linear)
        determinant = np.linalg.det(self._information(self.n * p * (1 - p)))
        likelihood = self.chosen @ linear - self.n @ np.logaddexp(0, linear)
        return float(likelihood + np.log(max(determinant, 1e-300)) / 2)

    def _step(self, b: Array, free: list[int]) -> Array:
        """Return a Newton step of the ``free`` coefficients, (terms,)."""
        p = expit(self.design @ b)
        information = self._information(self.n * p * (1 - p))
        step = np.zeros_like(b)
        step[free] = np.linalg.solve(information[np.ix_(free, free)], self._score(b)[free])
        return np.clip(step, -LONGEST_STEP, LONGEST_STEP)

    def _score(self, b: Array) -> Array:
        """Return the gradient of the penalised log-likelihood, (terms,).

        Firth's score adds to each residual the leverage times (1/2 - p): as if each trial were
        split, and half of its leverage had gone either way (Heinze and Schemper 2002).
        """
        p = expit(self.design @ b)
        weights = self.n * p * (1 - p)
        inverse = np.linalg.inv(self._information(weights))
        leverage = weights * ((self.design @ inverse) * self.design).sum(axis=1)
        return np.asarray((self.chosen - self.n * p + leverage * (0.5 - p)) @ self.design)
