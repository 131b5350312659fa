"""Regressions with a random intercept per human pair."""

from __future__ import annotations

import warnings
from functools import cache

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from scipy import optimize
from scipy.special import expit, logsumexp

from analysis.stats.regressions import (
    GAP_TERMS,
    WHO_FIRST_TERMS,
    Regression,
    Term,
    gap_data,
    unfit_for_logit,
    wald_term,
    who_first_data,
)

Array = NDArray[np.float64]
NODES = 25
MIN_PAIRS = 3  # fewer say nothing of how pairs vary
# Where the variance between pairs is this small beside that within, they do not differ.
ALIKE = 1e-6


def gap_mixed(trials: pd.DataFrame, measure: str = "gap_m") -> Regression:
    """Linear mixed model of a gap (restricted maximum likelihood), Wald z tests."""
    from statsmodels.regression.linear_model import OLS
    from statsmodels.regression.mixed_linear_model import MixedLM
    from statsmodels.tools.sm_exceptions import ConvergenceWarning, SingularMatrixWarning

    design, gap, chosen = gap_data(trials, measure)
    problem = _too_few_pairs(chosen["pair"]) or _rank(design)
    if problem:
        return Regression(len(gap), {}, problem)
    model = MixedLM(gap, design, groups=chosen["pair"].to_numpy())
    with warnings.catch_warnings():
        # What they warn of is checked below.
        warnings.simplefilter("ignore", ConvergenceWarning)
        warnings.simplefilter("ignore", SingularMatrixWarning)
        # It needs no gradient, and ends where others run into the edge of 0 variance, or too early.
        # By its own tolerance it stops where errors are still off in the fourth digit.
        fit = model.fit(reml=True, method="powell", ftol=1e-13)
    if float(fit.cov_re[0, 0]) >= ALIKE * float(fit.scale):
        if fit.converged and np.isfinite(fit.bse_fe).all():
            return Regression(len(gap), _wald(GAP_TERMS, fit.fe_params, fit.bse_fe))
        return Regression(len(gap), {}, "the mixed model does not converge")
    pooled = OLS(gap, design).fit()
    remark = "the pairs do not differ: their variance is 0, and the fit is the pooled one"
    return Regression(len(gap), _wald(GAP_TERMS, pooled.params, pooled.bse), remark=remark)


def who_first_mixed(trials: pd.DataFrame) -> Regression:
    """Logit with a normal random intercept per pair, by adaptive Gauss-Hermite quadrature.

    The marginal likelihood of each pair is integrated over its intercept with nodes placed at the
    mode and scaled by the curvature there (Pinheiro and Bates 1995).
    """
    chosen = trials[(trials["status"] == "finished") & trials["merged_first"].notna()]
    design, left = who_first_data(trials)
    problem = _too_few_pairs(chosen["pair"]) or unfit_for_logit(design, left)
    if problem:
        return Regression(len(left), {}, problem)
    pairs = chosen["pair"].to_numpy()
    parts = [_cells(design[pairs == pair], left[pairs == pair]) for pair in np.unique(pairs)]

    def loss(parameters: Array) -> float:
        return -sum(_marginal(parameters, *part) for part in parts)

    # The signs that I1 and I2 expect, and about the published SD between pairs.
    start = np.array([0.0, 0.5, -0.5, np.log(0.5)])
    found = optimize.minimize(loss, start, method="BFGS", options={"gtol": 1e-5})
    # Where pairs do not differ the likelihood is flat in their variance, and the Hessian singular.
    covariance = np.linalg.pinv(_hessian(loss, found.x))
    variances = np.diag(covariance)[:3]
    if np.abs(found.jac).max() > 1e-2 or not (variances > 0).all():
        return Regression(len(left), {}, "the mixed logit does not converge")
    return Regression(len(left), _wald(WHO_FIRST_TERMS, found.x[:3], np.sqrt(variances)))


def _wald(names: tuple[str, ...], estimates: Array, errors: Array) -> dict[str, Term]:
    return {
        name: wald_term(float(b), float(se))
        for name, b, se in zip(names, estimates, errors, strict=True)
    }


def _cells(design: Array, left: Array) -> tuple[Array, Array, Array]:
    """Trials of equal regressors as one binomial: design (k, 3), trials (k,), left-first (k,)."""
    cells, place, trials = np.unique(design, axis=0, return_inverse=True, return_counts=True)
    return cells, trials.astype(float), np.bincount(place, weights=left).astype(float)


def _marginal(parameters: Array, design: Array, trials: Array, left: Array) -> float:
    """The log-likelihood of one pair's trials, its intercept integrated out."""
    # The fourth parameter is the logarithm of the standard deviation, which so cannot be negative.
    fixed, sd = design @ parameters[:3], float(np.exp(parameters[3]))

    def joint(effect: Array) -> Array:
        """Log of likelihood times prior density, at intercepts ``effect`` of shape (k,)."""
        linear = fixed[:, None] + effect[None, :]
        fit = (left[:, None] * linear - trials[:, None] * np.logaddexp(0, linear)).sum(axis=0)
        return np.asarray(fit - effect**2 / (2 * sd**2) - np.log(sd * np.sqrt(2 * np.pi)))

    # Newton: the joint density is log-concave, so that it has a single mode.
    mode = 0.0
    for _ in range(50):
        p = expit(fixed + mode)
        slope = float((left - trials * p).sum() - mode / sd**2)
        curvature = float((trials * p * (1 - p)).sum() + 1 / sd**2)
        mode += slope / curvature
        if abs(slope / curvature) < 1e-10:
            break
    # The rule integrates f(x) exp(-x^2): the exponential that it supplies is taken out again, and
    # the scale is that of the change of variables (Pinheiro and Bates 1995).
    nodes, weights = _nodes()
    scale = np.sqrt(2 / curvature)
    return float(
        logsumexp(joint(mode + scale * nodes) + nodes**2 + np.log(weights)) + np.log(scale)
    )


@cache
def _nodes() -> tuple[Array, Array]:
    """Nodes and weights of Gauss-Hermite quadrature."""
    return np.polynomial.hermite.hermgauss(NODES)


def _hessian(function: object, at: Array) -> Array:
    from statsmodels.tools.numdiff import approx_hess

    return np.asarray(approx_hess(at, function))


def _too_few_pairs(pairs: pd.Series) -> str:
    found = pairs.nunique()
    return "" if found >= MIN_PAIRS else f"{found} pairs are too few for a random intercept"


def _rank(design: Array) -> str:
    enough = len(design) > design.shape[1] and np.linalg.matrix_rank(design) == design.shape[1]
    return "" if enough else "too few conditions to tell the terms apart"
