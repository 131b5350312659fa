"""Who merges first by Firth's penalised likelihood: profile intervals, and how two groups differ.

Likelihood-ratio tests and profile intervals hold where the data are separated, and Wald's do not
(Heinze and Schemper 2002). All trials are taken as independent.
"""

from __future__ import annotations

import warnings
from dataclasses import replace
from functools import cache
from typing import TYPE_CHECKING

import numpy as np
from scipy.linalg import LinAlgError

from analysis.data.study import Group
from analysis.stats.group_scores import fits
from analysis.stats.intervals import LEVEL, Difference
from analysis.stats.regressions import (
    MAX_ITERATIONS,
    WHO_FIRST_TERMS,
    Array,
    differences,
    who_first_data,
)

if TYPE_CHECKING:
    from firthmodels import FirthLogisticRegression

FIRTH, WALD = "Firth", "Firth, Wald"


@cache
def firth_intervals(group: Group) -> dict[str, tuple[float, float]]:
    """The 95 % profile intervals of Firth's fit by term, without those that do not converge."""
    if fits(group).firth.problem:
        return {}
    fit = _fitted(*who_first_data(group.outcomes))
    # firthmodels counts the intercept last.
    found = {
        term: _profile(fit, index) for term, index in zip(WHO_FIRST_TERMS, (2, 0, 1), strict=True)
    }
    return {term: bounds for term, bounds in found.items() if bounds is not None}


@cache
def firth_differences(group: Group, other: Group) -> dict[str, Difference]:
    """By term: the group's coefficient minus the other's; empty where one of the fits is missing.

    Test and interval are of the penalised likelihood of one model of both groups, in which every
    term may differ between them; what is detectable is Wald's. Where that does not converge all is
    Wald's, which is too wide under separation, and ``by`` says so.
    """
    found = differences(fits(group).firth, fits(other).firth, WALD)
    if not found:
        return {}
    (own, left), (rest, other_left) = who_first_data(group.outcomes), who_first_data(other.outcomes)
    design = np.block([[rest, 0 * rest], [own, own]])
    fit = _fitted(design, np.concatenate([other_left, left]))
    if not fit.converged_:
        return found
    first = design.shape[1] - len(WHO_FIRST_TERMS) - 1  # the common intercept is not a column
    return {term: _tested(fit, first + i, found[term]) for i, term in enumerate(WHO_FIRST_TERMS)}


def _tested(fit: FirthLogisticRegression, index: int, wald: Difference) -> Difference:
    bounds, p = _profile(fit, index), float(fit.lrt(features=index).lrt_pvalues_[index])
    if bounds is None or not np.isfinite(p):
        return wald
    return replace(wald, low=bounds[0], high=bounds[1], p=p, by=FIRTH)


def _fitted(design: Array, left: Array) -> FirthLogisticRegression:
    from firthmodels import FirthLogisticRegression

    # The trials of a condition that went alike as one row with a weight: that is as good, and fast.
    rows = np.column_stack([design[:, 1:], left])
    cells, weights = np.unique(rows, axis=0, return_counts=True)
    with warnings.catch_warnings():
        # It warns where it does not converge, which is checked where it matters.
        warnings.simplefilter("ignore", UserWarning)
        return FirthLogisticRegression(max_iter=MAX_ITERATIONS).fit(
            cells[:, :-1], cells[:, -1], sample_weight=weights
        )


def _profile(fit: FirthLogisticRegression, index: int) -> tuple[float, float] | None:
    with warnings.catch_warnings():
        # A bound that was not found is NaN.
        warnings.simplefilter("ignore", UserWarning)
        try:
            bounds = fit.conf_int(1 - LEVEL, "pl", index, max_iter=MAX_ITERATIONS)[index]
        except LinAlgError:
            return None
    return (float(bounds[0]), float(bounds[1])) if np.isfinite(bounds).all() else None
