"""What a group of trials scores: its regressions, its indicators, and the human ceiling.

Computed once per group and study; every table and figure reads it here.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np

from merge_runner_analysis.data.reference_data import published
from merge_runner_analysis.data.study import Group, Study
from merge_runner_analysis.stats.indicators import INDICATORS, Verdict, verdicts
from merge_runner_analysis.stats.likeness import piecewise_constant
from merge_runner_analysis.stats.regressions import (
    Regression,
    gap_ols,
    who_first_firth,
    who_first_logit,
)

PUBLISHED = "as published, no human traces are imported"
BY_EYE = "by eye, the paper"
PAPER_RULE, ROBUST_RULE = "by the paper's test", "by the robust tests"


@dataclass(frozen=True, slots=True)
class Fits:
    """The regressions of one group."""

    logit: Regression
    firth: Regression
    ols: Regression
    hc3: Regression


@cache
def fits(group: Group) -> Fits:
    """Fit a group's trials; without gaps the linear fits say so."""
    logit, firth = who_first_logit(group.outcomes), who_first_firth(group.outcomes)
    if not group.measured:
        missing = Regression(0, {}, PUBLISHED)
        return Fits(logit, firth, missing, missing)
    return Fits(logit, firth, gap_ols(group.trials), gap_ols(group.trials, robust=True))


@dataclass(frozen=True, slots=True)
class Score:
    """A group's verdicts by both rules, with I5 in both; ``sizes`` are its trials per condition."""

    paper: dict[str, Verdict]
    robust: dict[str, Verdict]
    sizes: tuple[int, ...]

    @property
    def rules(self) -> dict[str, dict[str, Verdict]]:
        """The verdicts by the name of their rule, as it stands in a sentence."""
        return {PAPER_RULE: self.paper, ROBUST_RULE: self.robust}

    @property
    def ceiling(self) -> dict[str, dict[str, float]]:
        """The human ceiling for the group's size."""
        return ceiling(self.sizes)


def ceiling(sizes: tuple[int, ...]) -> dict[str, dict[str, float]]:
    """Return by rule the shares of human data sets that pass each indicator, and ``I1-I4`` at once.

    It is that of the mean of ``sizes``, the trials in the conditions of the humans: of a shipped
    curve, which ``benchmarks/ceiling.py`` computed once from the published counts and the published
    regression of the gap with normal residuals; linear between its sizes, and constant beyond the
    largest. Without a trial in some condition there is no share.
    """
    shares: dict[str, dict[str, float]] = {"paper": {}, "robust": {}}
    if min(sizes):
        curves = published("human_ceiling").groupby(["rule", "indicator"], sort=False)
        for (rule, indicator), curve in curves:
            shares[rule][indicator] = float(np.interp(np.mean(sizes), curve["n"], curve["share"]))
    return shares


def total(judged: dict[str, Verdict]) -> str | None:
    """How many indicators hold by one rule, ``3 of 4``; None where none can be judged."""
    known = [verdict.passed for verdict in judged.values() if verdict.passed is not None]
    return f"{sum(known)} of {len(known)}" if known else None


@cache
def score(study: Study, group: Group) -> Score:
    """Judge a group's indicators."""
    fit = fits(group)
    paper = verdicts(fit.logit, fit.ols, robust=False)
    robust = verdicts(fit.firth, fit.hc3, robust=True)
    if not group.measured:
        row = published("paper_ablation_qualitative").query("driver == 'human'").iloc[0]
        for name in ("I3", "I4"):
            paper[name] = Verdict(bool(row[name.lower()]), PUBLISHED)
        paper["I5"] = Verdict(bool(row["i5"]), BY_EYE)
        robust["I5"] = Verdict(None, BY_EYE)
    elif group.caution:
        paper = robust = dict.fromkeys(INDICATORS, Verdict(None, group.caution))
    else:
        # The paper judged by eye: there is no rule to apply, whatever is driven.
        paper["I5"], robust["I5"] = Verdict(None), piecewise_constant(study, group)
    return Score(paper, robust, group.sizes)
