"""Who merges first by Firth's penalised likelihood: profile intervals.

Likelihood-ratio tests and profile intervals hold where the data are separated, and Wald's do not
(Heinze and Schemper 2002). All trials are taken as independent.
"""

from __future__ import annotations

import warnings
from functools import cache
from typing import TYPE_CHECKING

import numpy as np
from scipy.linalg import LinAlgError

from analysis.data.study import Group
from analysis.stats.group_scores import fits
from analysis.stats.intervals import LEVEL
from analysis.stats.regressions import (
    MAX_ITERATIONS,
    WHO_FIRST_TERMS,
    Array,
    who_first_data,
)

if TYPE_CHECKING:
    from firthmodels import FirthLogisticRegression


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
