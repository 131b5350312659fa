"""Coefficients of a prompt variant against those of its driver's baseline."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cache
from typing import TYPE_CHECKING

import numpy as np
from scipy.linalg import LinAlgError

from analysis.data.study import BASELINE, Group, Study
from analysis.stats.contrasts import corrected
from analysis.stats.group_scores import fits
from analysis.stats.intervals import Difference
from analysis.stats.regressions import (
    MAX_ITERATIONS,
    WHO_FIRST_TERMS,
    Array,
    Regression,
    difference,
    who_first_data,
)

if TYPE_CHECKING:
    from firthmodels import FirthLogisticRegression


Differences = Callable[[Group, Group], Mapping[str, Difference]]


@dataclass(frozen=True, slots=True)
class Corrected:
    """A difference of a variant, and its p corrected over the variants of its driver."""

    found: Difference
    holm: float
    bh: float


def variants(study: Study) -> Iterator[tuple[Group, Group | None]]:
    """Every variant with its driver's baseline, None where that was not played."""
    baselines = {group.driver: group for group in study.models if group.setting == BASELINE}
    for group in study.models:
        if group.setting != BASELINE:
            yield group, baselines.get(group.driver)


def corrected_differences(
    study: Study, differences: Differences
) -> dict[tuple[str, str], Corrected]:
    """By group and term what there is; a family is one term of one driver over its variants."""
    families: dict[tuple[str, str], dict[str, Difference]] = {}
    for group, baseline in variants(study):
        if baseline is not None:
            for term, found in differences(group, baseline).items():
                families.setdefault((group.driver, term), {})[group.id] = found
    return {
        (name, term): Corrected(found, float(holm), float(bh))
        for (_, term), family in families.items()
        for (name, found), holm, bh in zip(
            family.items(), *corrected([one.p for one in family.values()]), strict=True
        )
    }


@cache
def gap_differences(group: Group, baseline: Group) -> dict[str, Difference]:
    """By term of the gap's regression, with HC3 errors; empty where a group has no such fit."""
    first, second = fits(group).hc3, fits(baseline).hc3
    return _each(first, second, "HC3")


@cache
def who_first_differences(group: Group, baseline: Group) -> dict[str, Difference]:
    """By term of the logit; of Firth's fits where one of the two is not finite.

    Empty where these do not exist either.
    """
    one, other = fits(group), fits(baseline)
    if not (one.logit.problem or other.logit.problem):
        return _each(one.logit, other.logit, "logit")
    return {
        term: _penalised(group, baseline, term, found)
        for term, found in _each(one.firth, other.firth, "Firth, Wald").items()
    }


@cache
def firth_intervals(group: Group) -> dict[str, tuple[float, float]]:
    """The 95 % intervals of Firth's fit by term: profile penalised likelihood.

    A term whose profile does not converge is not there (Heinze and Schemper 2002).
    """
    if fits(group).firth.problem:
        return {}
    fit = _firth(*who_first_data(group.outcomes))
    found = {
        term: _profile(fit, index) for term, index in zip(WHO_FIRST_TERMS, (2, 0, 1), strict=True)
    }
    return {term: bounds for term, bounds in found.items() if bounds is not None}


def _each(first: Regression, second: Regression, by: str) -> dict[str, Difference]:
    found = {
        term: difference(first, second, term, by) for term in first.terms if term in second.terms
    }
    return {term: one for term, one in found.items() if one is not None}


def _penalised(group: Group, baseline: Group, term: str, found: Difference) -> Difference:
    """The same difference by the penalised likelihood of one model with all interactions.

    Wald's, which is too wide under separation, stands where that does not converge.
    """
    (first, left), (second, other_left) = (
        who_first_data(group.outcomes),
        who_first_data(baseline.outcomes),
    )
    both = np.vstack([first, second])
    of_first = np.vstack([first, np.zeros_like(second)])
    fit = _firth(np.hstack([both, of_first]), np.concatenate([left, other_left]))
    index = 2 + WHO_FIRST_TERMS.index(term)  # the intercept of both is not counted
    bounds = _profile(fit, index) if fit.converged_ else None
    if bounds is None:
        return found
    p = float(fit.lrt(features=index).lrt_pvalues_[index])
    if not np.isfinite(p):
        return found
    return replace(found, low=bounds[0], high=bounds[1], p=p, by="Firth")


def _firth(design: Array, left: Array) -> FirthLogisticRegression:
    from firthmodels import FirthLogisticRegression

    return FirthLogisticRegression(max_iter=MAX_ITERATIONS).fit(design[:, 1:], left)


def _profile(fit: FirthLogisticRegression, index: int) -> tuple[float, float] | None:
    with warnings.catch_warnings():
        # A bound that was not found is NaN.
        warnings.filterwarnings("ignore", "Profile-likelihood CI did not converge")
        try:
            bounds = fit.conf_int(method="pl", features=index, max_iter=MAX_ITERATIONS)[index]
        except LinAlgError:
            return None
    return (float(bounds[0]), float(bounds[1])) if np.isfinite(bounds).all() else None
