"""The humans that drivers are compared with: an estimate of each measure, for a group's conditions.

Until the trials of MIN_PAIRS pairs are imported, gaps follow from the published regression.
"""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pandas as pd

from merge_runner_analysis.cache import remembered
from merge_runner_analysis.facts import Fact, Why
from merge_runner_analysis.grouping import Group
from merge_runner_analysis.metrics import BOXES, GAP
from merge_runner_analysis.published import HUMAN_GAP_SD_M, PAIRS, human_outcomes, published
from merge_runner_analysis.stats import intervals, measures, regressions
from merge_runner_analysis.stats.estimate import Array, Estimate
from merge_runner_analysis.stats.indicators import TESTED, fits
from merge_runner_analysis.stats.regressions import CONDITION, GAP_TERMS, MIN_PAIRS, Regression
from merge_runner_analysis.stats.score_interval import wilson
from merge_runner_analysis.study import StudyResults

PUBLISHED = Fact(Why.PUBLISHED)
# By measure of who goes first: the term of Firth's fit.
SLOPES = {"headway": TESTED["I1"][0], "velocity": TESTED["I2"][0]}


def human_estimates(human: Group, group: Group) -> dict[str, Estimate]:
    """Return the humans by measure, in the conditions of a group."""
    fit = human_fit(human)
    gaps = {"gap-headway": headway_slope(fit), "gap-velocity": largest_difference(fit, group)}
    for name, estimate in gaps.items():
        if estimate.problem:
            gaps[name] = replace(estimate, problem=Fact(Why.OF_HUMANS, (estimate.problem,)))
        elif not _imported(human):
            gaps[name] = replace(estimate, source=PUBLISHED)
    return {
        **{name: who_first_slope(human, term) for name, term in SLOPES.items()},
        "collisions": _collisions(human, group),
        "gap": human_gap(human, group),
        **gaps,
        "held": Estimate(0.0, n=len(human.finished)),
    }


@remembered
def of_humans(study: StudyResults) -> dict[str, Estimate]:
    """Return the humans by measure, over all conditions; a few imported trials change nothing."""
    human = study.human
    every = human if _imported(human) else replace(human, trials=human.outcomes)
    return human_estimates(human, every)


@remembered
def who_first_slope(group: Group, term: str) -> Estimate:
    """Return a slope of who goes first by Firth's fit, with its profile interval."""
    fit = fits(group).firth
    if fit.problem:
        return Estimate(n=fit.n, problem=fit.problem)
    b, se = fit.terms[term].b, fit.terms[term].se
    if ends := fit.interval(term, intervals.LEVEL):
        return Estimate(b, *ends, fit.n, se)
    return Estimate(b, n=fit.n, se=se, problem=Fact(Why.NO_PROFILE))


def headway_slope(fit: Regression) -> Estimate:
    """Return the slope of the gap on headway."""
    if fit.problem:
        return Estimate(n=fit.n, problem=fit.problem)
    term = fit.terms[TESTED["I3"][0]]
    return intervals.estimate(term.b, term.se, fit.freedom, fit.n)


def largest_difference(fit: Regression, group: Group) -> Estimate:
    """Return the largest difference of gaps that relative velocity alone makes for a group."""
    moved = fit.moved(group.trials)
    if moved is None:
        return Estimate(n=fit.n, problem=fit.problem or Fact(Why.NONE_APART))
    return Estimate(moved.most, *moved.interval(intervals.LEVEL), fit.n)


def _collisions(human: Group, group: Group) -> Estimate:
    """Return the humans' collisions, with conditions weighted as in a group's trials."""
    played = group.ended_outcomes["condition"].value_counts()  # with those undecided
    outcomes = human.outcomes
    shared = outcomes[outcomes["condition"].isin(played.index)]
    if shared.empty:
        return Estimate(problem=Fact(Why.NOBODY_THERE))
    counts = shared.groupby("condition")[BOXES.column].agg(["sum", "size"]).astype(int)
    k, n = counts.to_numpy().T
    shares = played[counts.index].to_numpy() / played[counts.index].sum()
    rate, effective_n = float(shares @ (k / n)), 1 / float(shares**2 @ (1 / n))
    low, high = wilson(rate, effective_n)
    return Estimate(100 * rate, 100 * low, 100 * high, len(shared), effective_n=effective_n)


def human_gap(human: Group, group: Group) -> Estimate:
    """Return the humans' mean gap, weighted by condition as the group's trials that have a gap.

    The published mean is moved by the published regression; its error is the spread of the pairs'
    random intercepts, which are shrunken, so that it is rather too small.
    """
    gaps = group.finished.dropna(subset=GAP.column) if group.measured else pd.DataFrame()
    if _imported(human):
        known = human.finished.dropna(subset=GAP.column)
        if gaps.empty:
            return measures.mean_of(known, GAP.column)
        shares = gaps["condition"].value_counts()
        if lacking := {*shares.index} - {*known["condition"]}:
            return Estimate(n=len(known), problem=Fact(Why.NO_GAP_THERE, (len(lacking),)))
        shared = known[known["condition"].isin(shares.index)]
        return measures.mean_of(shared, GAP.column, None if group is human else shares)
    (value, usual, spread), fit = _published_gap(), human_fit(human)
    moved = np.zeros(len(GAP_TERMS))
    if len(gaps):
        moved = _gap_design(gaps).mean(axis=0) - usual
    assert fit.covariance is not None
    se = float(spread**2 + moved @ fit.covariance @ moved) ** 0.5
    value += float(moved @ [term.b for term in fit.terms.values()])
    return replace(intervals.estimate(value, se, len(PAIRS) - 1, fit.n), source=PUBLISHED)


@cache
def _published_gap() -> tuple[float, Array, float]:
    """Return the humans' mean gap in m, the mean regressors of its trials, and its error in m."""
    row = published("paper_ablation_quantitative").query("driver == 'human'").iloc[0]
    outcomes = human_outcomes().query("status == 'finished'")
    spread = float(published("human_gap_intercepts")["intercept_m"].std() / len(PAIRS) ** 0.5)
    return float(row["gap_m"]), _gap_design(outcomes).mean(axis=0), spread


def _gap_design(trials: pd.DataFrame) -> Array:
    return regressions.gap_design(*trials[CONDITION].to_numpy(float).T)


@remembered
def human_fit(human: Group) -> Regression:
    """Return the humans' regression of the gap: by pairs, or as published.

    Covariances that are not published follow from the outcomes and one standard deviation.
    """
    if _imported(human):
        return regressions.by_pairs(regressions.gap_ols, human.trials, "gap_m")
    rows = published("paper_gap").query("driver == 'human'").set_index("term")
    design = _gap_design(human_outcomes().query("status == 'finished'"))
    covariance = HUMAN_GAP_SD_M**2 * np.asarray(np.linalg.inv(design.T @ design))
    terms = {
        name: regressions.Term(float(rows.at[name, "b"]), float(rows.at[name, "se"]), None, np.nan)
        for name in GAP_TERMS
    }
    n = int(rows["n"].iloc[0])
    return Regression(n, terms, freedom=n - len(GAP_TERMS), covariance=covariance)


def _imported(human: Group) -> bool:
    return human.measured and human.finished["pair"].nunique() >= MIN_PAIRS
