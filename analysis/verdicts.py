"""What a group of trials scores: its regressions, its indicators, and the human ceiling.

Computed once per group and study; every table and figure reads it here.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache

import pandas as pd

from analysis.ceiling import Ceiling, Population, ceiling, imported_humans, published_humans
from analysis.indicators import Verdict, paper_verdicts, robust_verdicts
from analysis.intervals import Estimate, proportion
from analysis.piecewise import THRESHOLDS, Thresholds, passing
from analysis.published import published
from analysis.regressions import Regression, gap_ols, who_first_firth, who_first_logit
from analysis.study import Group, Study, of_group

REVERSAL_QUANTILE = 0.95
PUBLISHED = "as published, no human traces are imported"


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
    """A group's verdicts by both rules, with I5 in both, and what to draw its ceiling from.

    ``sizes`` are its trials per condition.
    """

    paper: dict[str, Verdict]
    robust: dict[str, Verdict]
    humans: Population
    sizes: tuple[int, ...]

    @property
    def ceiling(self) -> Ceiling:
        """The human ceiling for the group's size."""
        return ceiling(self.humans, self.sizes)


@dataclass(frozen=True, slots=True)
class Total:
    """How many indicators hold, of those that can be judged; ``open`` names the others."""

    passed: int
    judged: int
    open: tuple[str, ...]

    def __str__(self) -> str:
        return f"{self.passed} of {self.judged}"


def total(verdicts: dict[str, Verdict]) -> Total:
    """The score of a group by one rule."""
    known = {name: v.passed for name, v in verdicts.items() if v.passed is not None}
    return Total(sum(known.values()), len(known), tuple(n for n in verdicts if n not in known))


@cache
def score(study: Study, group: Group) -> Score:
    """Judge a group's indicators."""
    fit = fits(group)
    paper, robust = paper_verdicts(fit.logit, fit.ols), robust_verdicts(fit.firth, fit.hc3)
    piecewise = piecewise_verdict(study, group)
    if not group.measured:
        row = published("paper_ablation_qualitative").query("driver == 'human'").iloc[0]
        for name in ("I3", "I4"):
            paper[name] = Verdict(bool(row[name.lower()]), None, PUBLISHED)
        piecewise = Verdict(bool(row["i5"]), None, f"{PUBLISHED}, judged by eye")
    return Score(
        paper | {"I5": piecewise},
        robust | {"I5": piecewise},
        population(study),
        group.sizes,
    )


@cache
def thresholds(study: Study) -> Thresholds:
    """The limits of I5; the reversal rate's is the human 95th percentile once it is known."""
    if not study.calibrated:
        return THRESHOLDS
    human = of_group(study.profiles, study.human, study.human.finished)
    limit = float(human["reversal_rate_hz"].quantile(REVERSAL_QUANTILE))
    return replace(THRESHOLDS, max_reversal_rate_hz=limit)


@cache
def piecewise_trials(study: Study, group: Group) -> pd.Series:
    """Whether both profiles of each finished trial pass I5; indexed by trial_id."""
    profiles = of_group(study.profiles, group, group.finished)
    return passing(profiles, thresholds(study)).groupby(profiles["trial_id"]).all()


def piecewise_share(study: Study, group: Group) -> Estimate:
    """The share of a group's finished trials that pass I5."""
    passes = piecewise_trials(study, group)
    return proportion(int(passes.sum()), len(passes))


def piecewise_verdict(study: Study, group: Group) -> Verdict:
    """I5 of a group of measured trials."""
    if not group.measured:
        return Verdict(None, None, "no human traces are imported")
    share = piecewise_share(study, group)
    if share.low is None:
        return Verdict(None, None, "no finished trial")
    best = proportion(share.n, share.n).low
    if best is not None and best < THRESHOLDS.min_share:
        return Verdict(None, None, f"{share.n} finished trials are too few, even if all pass")
    return Verdict(bool(share.low >= THRESHOLDS.min_share))


@cache
def population(study: Study) -> Population:
    """The humans from whom the ceilings are drawn."""
    human = study.human
    if not study.complete:
        return published_humans()
    passes = piecewise_trials(study, human)
    return imported_humans(human.ended, human.ended["trial_id"].map(passes).astype(float))
