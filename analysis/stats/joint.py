"""Whether a driver differs from the humans: one model of both, with the source in every term.

Who merged first is left ~ (h + dv) x source (logit), the gap is ~ (|h| + |dv| + h*dv) x source
(least squares); source is 1 for the driver and 0 for the humans. Since it stands in every term, the
likelihood, and Firth's penalty, fall apart into one factor of the humans and one of the driver: an
interaction is the driver's coefficient minus the humans' (see ``regressions.difference``).

The driver's trials are independent: Fisher's information in the logit, HC3 errors for the gap. The
humans' come from pairs who differ: a jackknife over the pairs (CV3 of MacKinnon, Nielsen and Webb
2023, on pairs - 1 degrees of freedom), with Satterthwaite's degrees of freedom (1946) for the sum.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache
from math import sqrt

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from analysis.data.reference_data import citation, published
from analysis.data.study import Group
from analysis.stats.group_scores import fits
from analysis.stats.intervals import LEVEL, Difference
from analysis.stats.mixed import MIN_PAIRS
from analysis.stats.regressions import (
    GAP_TERMS,
    MAX_ITERATIONS,
    WHO_FIRST_TERMS,
    Regression,
    difference,
    gap_ols,
    wald_term,
    who_first_data,
    who_first_logit,
)

WHO_FIRST = "who-first"
GAP = "gap"
NARROW = "trials are taken as independent, and the interval is too narrow"
NO_PAIRS = f"which pair drove is not published: {NARROW}"


@dataclass(frozen=True, slots=True)
class Interaction:
    """How far a term of ``outcome`` differs between a driver and the humans.

    That of ``intercept`` is the source itself. ``driver`` and ``human`` are the two coefficients,
    ``n`` and ``n_human`` their trials, and ``found`` the driver's minus the humans'. ``problem``
    says why there is none of these; ``remark`` what to know of them.
    """

    outcome: str
    term: str
    n: int
    n_human: int
    driver: float | None = None
    human: float | None = None
    found: Difference | None = None
    problem: str = ""
    remark: str = ""


@cache
def differences(human: Group, group: Group) -> tuple[Interaction, ...]:
    """How a driver differs from the humans: in who merged first, then in the gap, by term."""
    return (*_of_who_first(human, group), *_of_gap(human, group))


def pairs_known(human: Group, outcome: str) -> int:
    """How many pairs of imported humans have the outcome; 0 where that of the published counts."""
    trials = human.outcomes if outcome == WHO_FIRST else human.finished
    return trials["pair"].nunique() if "pair" in trials else 0


def by_pairs(
    fit: Callable[[pd.DataFrame], Regression], trials: pd.DataFrame, measure: str
) -> Regression:
    """A fit with the errors of a jackknife over the pairs of those trials that have the measure."""
    used = trials[(trials["status"] == "finished") & trials[measure].notna()]
    whole, pairs = fit(used), used["pair"].unique()
    parts = {pair: fit(used[used["pair"] != pair]) for pair in pairs} if whole.terms else {}
    lacking = [f"without {pair}: {part.problem}" for pair, part in parts.items() if part.problem]
    if whole.problem or lacking:
        return Regression(whole.n, {}, whole.problem or lacking[0])
    # CV3: the squares of what each pair moves an estimate by, about the whole fit and not the mean.
    freedom = len(pairs) - 1
    terms = {}
    for name, term in whole.terms.items():
        moved = sum((part.terms[name].b - term.b) ** 2 for part in parts.values())
        terms[name] = wald_term(term.b, sqrt(moved * freedom / len(pairs)), freedom)
    remark = f"errors by jackknife over {len(pairs)} pairs"
    return Regression(whole.n, terms, freedom=freedom, remark=remark)


def _of_who_first(human: Group, group: Group) -> list[Interaction]:
    mine, theirs = fits(group), _human_who_first(human)
    if mine.logit.terms and theirs.terms:
        return [_interaction(WHO_FIRST, term, mine.logit, theirs, "ML") for term in WHO_FIRST_TERMS]
    return _by_firth(human, group, theirs)


def _of_gap(human: Group, group: Group) -> list[Interaction]:
    mine, theirs = fits(group).hc3, _human_gap(human)
    if mine.terms and theirs.terms:
        return [_interaction(GAP, term, mine, theirs, "least squares") for term in GAP_TERMS]
    problem = mine.problem or f"humans: {theirs.problem}"
    return [Interaction(GAP, term, mine.n, theirs.n, problem=problem) for term in GAP_TERMS]


@cache
def _human_who_first(human: Group) -> Regression:
    """The humans' logit; published outcomes know no pairs."""
    pairs = pairs_known(human, WHO_FIRST)
    if pairs >= MIN_PAIRS:
        return by_pairs(who_first_logit, human.outcomes, "merged_first")
    fit = fits(human).logit
    remark = f"{pairs} pairs are too few: {NARROW}" if pairs else NO_PAIRS
    return Regression(fit.n, fit.terms, fit.problem, remark=remark)


@cache
def _human_gap(human: Group) -> Regression:
    """The humans' regression of the gap, as published while there are not traces of three pairs."""
    if pairs_known(human, GAP) >= MIN_PAIRS:
        return by_pairs(gap_ols, human.trials, "gap_m")
    rows = published("paper_gap").query("driver == 'human'").set_index("term")
    n = int(rows["n"].iloc[0])
    freedom = n - len(GAP_TERMS)
    terms = {
        name: wald_term(float(rows["b"][name]), float(rows["se"][name]), freedom)
        for name in GAP_TERMS
    }
    remark = f"humans as published ({citation('paper_gap')}); {NO_PAIRS}"
    return Regression(n, terms, freedom=freedom, remark=remark)


def _interaction(
    outcome: str, term: str, driver: Regression, human: Regression, method: str
) -> Interaction:
    """The interaction of a term with the source."""
    found = difference(driver, human, term, method)
    if found is None:
        problem = "neither the driver nor the humans vary: there is nothing to test"
        return Interaction(outcome, term, driver.n, human.n, problem=problem)
    return Interaction(
        outcome,
        term,
        driver.n,
        human.n,
        driver.terms[term].b,
        human.terms[term].b,
        found,
        remark=human.remark,
    )


def _by_firth(human: Group, group: Group, theirs: Regression) -> list[Interaction]:
    """The joint logit by Firth's penalised likelihood, where maximum likelihood has no estimate.

    Tests and intervals are those of the penalised likelihood (Heinze and Schemper 2002), which
    takes all trials as independent.
    """
    mine, humans = fits(group).firth, fits(human).firth
    problem = mine.problem or (f"humans: {humans.problem}" if humans.problem else "")
    if not problem:
        found = _penalised(human, group)
        problem = "" if found is not None else "Firth's penalised joint fit does not converge"
    if problem or found is None:
        return [
            Interaction(WHO_FIRST, term, mine.n, humans.n, problem=problem)
            for term in WHO_FIRST_TERMS
        ]
    remark = theirs.remark if theirs.terms and NARROW in theirs.remark else f"Firth's fit: {NARROW}"
    return [
        _by_likelihood(_interaction(WHO_FIRST, term, mine, humans, "Firth"), p, bounds, remark)
        for term, p, bounds in zip(WHO_FIRST_TERMS, *found, strict=True)
    ]


def _by_likelihood(
    one: Interaction, p: float, bounds: NDArray[np.float64], remark: str
) -> Interaction:
    """The same interaction by another test and interval; what is detectable stays Wald's."""
    assert one.found is not None, "Firth's estimates always have errors"
    low, high = map(float, bounds)
    return replace(one, found=replace(one.found, low=low, high=high, p=float(p)), remark=remark)


def _penalised(
    human: Group, group: Group
) -> tuple[NDArray[np.float64], NDArray[np.float64]] | None:
    """Penalised likelihood-ratio p (3,) and profile bounds (3, 2) of source and interactions."""
    from firthmodels import FirthLogisticRegression

    (x, left), (own, own_left) = who_first_data(human.outcomes), who_first_data(group.outcomes)
    joint = np.vstack([np.hstack([x, 0 * x]), np.hstack([own, own])])
    rows = np.column_stack([joint[:, 1:], np.concatenate([left, own_left])])
    # The trials of a condition that went alike as one row with a weight: that is as good, and fast.
    cells, weights = np.unique(rows, axis=0, return_counts=True)
    model = FirthLogisticRegression(max_iter=MAX_ITERATIONS)
    features = [2, 3, 4]  # after h and dv, the intercept being the model's own
    with warnings.catch_warnings():
        # It warns where it does not converge, which is checked below.
        warnings.simplefilter("ignore", UserWarning)
        fit = model.fit(cells[:, :-1], cells[:, -1], sample_weight=weights)
        p = fit.lrt(features).lrt_pvalues_[features]
        bounds = fit.conf_int(1 - LEVEL, "pl", features, max_iter=MAX_ITERATIONS)[features]
    sound = fit.converged_ and np.isfinite(p).all() and np.isfinite(bounds).all()
    return (p, bounds) if sound else None
