"""Firth's penalised logit of many data sets at once, and where data are separated.

A data set is counts per row of a design. It is finite under separation (Firth 1993; Heinze and
Schemper 2002).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import stats
from scipy.optimize import linprog
from scipy.special import expit

Array = NDArray[np.float64]
Holds = NDArray[np.bool_]

STEPS = 60
HALVINGS = 8
# Of a log-likelihood: what is smaller than this is no loss.
ROUNDING = 1e-11


def tested_fits(
    design: Array, n: Array, left: Array, tested: tuple[int, ...]
) -> tuple[Array, Array, Holds]:
    """Firth's coefficients (sets, terms), p-values of the ``tested`` (else 1), and where they are.

    ``n`` and ``left`` are counts of the shape (sets, rows of the design).
    """
    alive = identified(design, n)
    every = tuple(range(design.shape[1]))
    full, b, found = _fit(design, n, left, alive, every)
    p = np.ones_like(b)
    for column in tested:
        without = tuple(other for other in every if other != column)
        constrained, _, settled = _fit(design, n, left, alive, without)
        found &= settled
        p[:, column] = stats.chi2.sf(2 * (full - constrained), 1)
    return b, p, found


def signed_roots(
    design: Array, n: Array, left: Array, column: int, estimate: float, at: Array
) -> Array:
    """The signed roots of twice what the profile likelihood of one data set loses, (k,).

    ``estimate`` is the coefficient of ``column``, which is held at each of the values ``at`` (k,).
    """
    values = np.append(at, estimate)
    start = np.zeros((len(values), design.shape[1]))
    start[:, column] = values
    free = tuple(other for other in range(design.shape[1]) if other != column)
    some, firsts = np.tile(n, (len(values), 1)), np.tile(left, (len(values), 1))
    # Far out the last steps are small and many: what they add to the likelihood is less than seen.
    best, _, _ = _fit(design, some, firsts, np.ones(len(values), bool), free, start)
    loss = np.maximum(best[-1] - best[:-1], 0.0)
    return np.asarray(np.sign(at - estimate) * np.sqrt(2 * loss))


def _fit(
    design: Array,
    n: Array,
    left: Array,
    alive: Holds,
    free: tuple[int, ...],
    start: Array | None = None,
) -> tuple[Array, Array, Holds]:
    """Maximal penalised log-likelihoods (sets,), coefficients (sets, terms), and convergence.

    Only the ``free`` coefficients differ from 0, or from those of ``start``.

    Newton steps on Firth's score with the whole design's information, halved where they do not
    increase the penalised likelihood (Heinze and Schemper 2002).
    """
    b = np.zeros((len(n), design.shape[1])) if start is None else start.copy()
    best = np.zeros(len(n))
    rows = np.flatnonzero(alive)  # a data set that has converged is left as it is
    best[rows] = _penalised(design, n[rows], left[rows], b[rows])
    for _ in range(STEPS):
        some, firsts = n[rows], left[rows]
        step = _step(design, some, firsts, b[rows], free)
        for _ in range(HALVINGS):
            tried = _penalised(design, some, firsts, b[rows] + step)
            worse = tried < best[rows] - ROUNDING
            if not worse.any():
                break
            step[worse] /= 2
        step[worse] = 0
        b[rows] += step
        best[rows] = np.maximum(tried, best[rows])
        rows = rows[np.abs(step).max(axis=1) >= 1e-8]
        if not len(rows):
            break
    settled = alive.copy()
    settled[rows] = False
    return best, b, settled


def _penalised(design: Array, n: Array, left: Array, b: Array) -> Array:
    """Log-likelihoods of the coefficients ``b`` (sets, terms) with Firth's penalty.

    It is half the logarithm of the determinant of the information: Jeffreys' prior (Firth 1993).
    """
    linear = b @ design.T
    p = expit(linear)
    determinant = np.linalg.det(information(design, n * p * (1 - p)))
    fit = (left * linear - n * np.logaddexp(0, linear)).sum(axis=1)
    return np.asarray(fit + np.log(np.maximum(determinant, 1e-300)) / 2)


def _step(design: Array, n: Array, left: Array, b: Array, free: tuple[int, ...]) -> Array:
    """A Newton step (sets, terms) of the ``free`` coefficients from ``b``."""
    alive = np.ones(len(b), bool)
    p = expit(b @ design.T)
    weights = n * p * (1 - p)
    covariance, _ = inverse(design, weights, alive)
    # Firth's score adds to each residual the leverage times (1/2 - p): as if each trial were split,
    # and half of its leverage had gone either way (Heinze and Schemper 2002).
    leverage = weights * (covariance.reshape(-1, design.shape[1] ** 2) @ _products(design).T)
    score = (left - n * p + leverage * (0.5 - p)) @ design
    step = np.zeros_like(b)
    step[:, free] = np.einsum(
        "bjk,bk->bj", inverse(design[:, free], weights, alive)[0], score[:, free]
    )
    # Near separation a Newton step can leave the region where the information is regular.
    return np.clip(step, -5, 5)


def inverse(design: Array, weights: Array, alive: Holds) -> tuple[Array, Holds]:
    """(X' W X)^-1 for each row of ``weights``, and where it exists; elsewhere the identity."""
    of_each, size = information(design, weights), design.shape[1]
    sound = alive & (np.linalg.det(of_each) > 1e-12)
    return np.linalg.inv(np.where(sound[:, None, None], of_each, np.eye(size))), sound


def identified(design: Array, n: Array) -> Holds:
    """In which data sets the conditions with trials tell all terms apart."""
    played = information(design, (n > 0).astype(float))
    return np.asarray(np.linalg.matrix_rank(played) == design.shape[1])


def information(design: Array, weights: Array) -> Array:
    """X' W X for each row of ``weights`` (sets, conditions)."""
    size = design.shape[1]
    return np.asarray((weights @ _products(design)).reshape(-1, size, size))


def _products(design: Array) -> Array:
    """The products of each two regressors, (conditions, regressors squared)."""
    return np.asarray((design[:, :, None] * design[:, None, :]).reshape(len(design), -1))


def infinite_coefficients(design: Array, n: Array, left: Array) -> Holds:
    """Which coefficients of a logit have no finite maximum likelihood estimate, (terms,).

    ``n`` and ``left`` are counts by row of the design. Separation is a direction in which no row's
    outcome becomes less likely; the linear program of Konis (2007) finds the one that gains most.
    """
    signed = np.vstack([design[left > 0], -design[left < n]])
    found = linprog(-signed.sum(axis=0), A_ub=-signed, b_ub=np.zeros(len(signed)), bounds=(-1, 1))
    return np.asarray(np.abs(found.x) > 1e-4)
