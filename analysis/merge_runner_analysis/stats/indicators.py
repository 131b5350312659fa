"""The qualitative indicators I1 to I5: by the paper's rule, and by robust tests.

The paper (arXiv 2604.09609, Table V) judges signs and p < 0.05 of Wald tests, I4 by the main effect
of |dv| alone. Human data are nearly separable, where Wald tests lose their power, and a large p is
no evidence of no effect. So I1 and I2 are judged again by likelihood-ratio tests of Firth's fit, I3
by an HC3 test, and I4 by equivalence. Two played conditions that differ in relative velocity alone
have predicted gaps less than a margin apart, by two one-sided tests (Schuirmann 1987). All such
pairs must pass (Berger 1982).

I5 holds where the whole 95 % interval of the mean gain (see ``held``) of trials with control action
lies above 0: accelerations are piecewise constant.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np
import pandas as pd

from merge_runner_analysis.cache import remembered
from merge_runner_analysis.facts import Fact, Why
from merge_runner_analysis.frames import KEYS, SPEEDS, read
from merge_runner_analysis.grouping import Group, of_trials
from merge_runner_analysis.published import published
from merge_runner_analysis.stats import regressions
from merge_runner_analysis.stats.estimate import Estimate
from merge_runner_analysis.stats.held import KEY, measure_profiles
from merge_runner_analysis.stats.intervals import difference, mean
from merge_runner_analysis.stats.regressions import Regression
from merge_runner_analysis.study import StudyResults
from merge_runner_analysis.wording import ALPHA, INDICATORS

AT_ONCE = 4_000  # trials whose samples are in memory together
PUBLISHED, BY_EYE = Fact(Why.NO_TRACES), Fact(Why.BY_EYE)
# By indicator: the term that decides it, and the sign that it needs; I4's is to have no effect.
TESTED = {
    "I1": ("projected_headway", 1),
    "I2": ("relative_velocity", -1),
    "I3": ("abs_projected_headway", 1),
    "I4": ("abs_relative_velocity", 0),
}


class Judgement(NamedTuple):
    """Verdict on an indicator: ``passed`` is None where the data cannot tell, for ``why``."""

    passed: bool | None
    why: Fact | None = None


def disagree(first: Judgement, second: Judgement) -> bool:
    """Return whether one judgement passed and the other failed."""
    return None not in {first.passed, second.passed} and first.passed != second.passed


def judge(who_first: Regression, gap: Regression, *, robust: bool) -> dict[str, Judgement]:
    """Judge I1 to I4 by the paper's rule, or the ``robust`` one for Firth's fit and HC3 errors."""
    return {
        name: _judged(who_first if name in {"I1", "I2"} else gap, name, robust=robust)
        for name in TESTED
    }


def _judged(fit: Regression, name: str, *, robust: bool) -> Judgement:
    if fit.problem:
        return Judgement(None, fit.problem)
    name_of_term, sign = TESTED[name]
    term = fit.terms[name_of_term]
    if sign:
        return Judgement(sign * term.b > 0 and term.p < ALPHA)
    if not robust:
        return Judgement(term.p >= ALPHA)
    if fit.equivalence_p is None:
        return Judgement(None, Fact(Why.NONE_APART))
    return Judgement(fit.equivalence_p < ALPHA)


def profiles(study: StudyResults, group: Group) -> pd.DataFrame:
    """Return one row per vehicle: whether it acted, and the gain of its speed profile."""
    return of_trials(_all_profiles(study), group.trials)


@remembered
def _all_profiles(study: StudyResults) -> pd.DataFrame:
    # Part after part: the samples of all vehicles take the most memory of all tables.
    parts = len(study.frames.trials) // AT_ONCE + 1
    speeds = (
        read(study.db, f"FROM ({SPEEDS}) WHERE hash(trial_id) % {parts} = {part}")
        for part in range(parts)
    )
    return pd.concat(map(measure_profiles, speeds)).sort_values(KEY, ignore_index=True)


@remembered
def gains(study: StudyResults, group: Group) -> pd.DataFrame:
    """Return one row per finished trial: condition, pair, ``steady`` (nobody acted), ``gain``."""
    by_trial = profiles(study, group).groupby(KEYS, as_index=False)
    gain = by_trial.agg(steady=("steady", "all"), gain=("gain", "mean"))
    return group.finished[[*KEYS, "condition", "pair"]].merge(gain, on=KEYS)


def mean_gain(study: StudyResults, group: Group) -> Estimate:
    """Return the mean gain of a group's trials; for humans, of the means of their pairs."""
    known = gains(study, group).dropna(subset="gain")
    return replace(mean(_independent(known, "gain")), n=len(known))


def less_humans(study: StudyResults, group: Group) -> Estimate | None:
    """Return the mean gain less the humans' in equal conditions, in their SD, if known."""
    if group is study.human or not study.calibrated:
        return None
    return likeness(gains(study, group), gains(study, study.human))


def likeness(driver: pd.DataFrame, human: pd.DataFrame) -> Estimate:
    """Return the difference of ``gains`` in human SDs, by Welch's test over pairs."""
    driver, human = driver.dropna(subset="gain"), human.dropna(subset="gain")
    usual = human.groupby("condition")["gain"].mean()
    human = human.assign(apart=human["gain"] - human["condition"].map(usual))
    spread = float((human["apart"] ** 2).sum() / max(len(human) - len(usual), 1)) ** 0.5
    apart = (driver["gain"] - driver["condition"].map(usual)).dropna()
    if not spread:
        return Estimate(n=len(apart))
    gain, human_gain = mean(apart / spread), mean(_independent(human, "apart") / spread)
    if gain.value is None or gain.se is None or human_gain.se is None:
        return Estimate(gain.value, n=gain.n)
    if test := difference(gain, replace(human_gain, value=0.0)):
        return Estimate(gain.value, test.low, test.high, gain.n, test.se, test.freedom)
    return Estimate(gain.value, gain.value, gain.value, gain.n, 0.0)  # nothing varies: it is sure


def _independent(trials: pd.DataFrame, column: str) -> pd.Series:
    """Return values of trials, or means of human pairs, whose trials are correlated."""
    paired = trials["pair"].notna()
    means = trials[paired].groupby("pair")[column].mean()
    return pd.concat([trials.loc[~paired, column], means])


def piecewise_constant(study: StudyResults, group: Group) -> Judgement:
    """Judge I5: whether the accelerations of a group are piecewise constant."""
    gain = mean_gain(study, group)
    if gain.low is not None:
        return Judgement(gain.low > 0)
    return Judgement(None, Fact(Why.ONE_ACTION if gain.n else Why.NO_ACTION))


class Fits(NamedTuple):
    """The regressions of one group."""

    logit: Regression
    firth: Regression
    ols: Regression
    hc3: Regression


@remembered
def fits(group: Group) -> Fits:
    """Fit a group's trials; without known gaps the linear fits have a ``problem``."""
    logit = regressions.who_first_logit(group.outcomes)
    firth = regressions.who_first_firth(group.outcomes)
    ols = hc3 = Regression(0, {}, PUBLISHED)
    if group.measured:
        ols = regressions.gap_ols(group.trials)
        hc3 = regressions.gap_ols(group.trials, robust=True)
    return Fits(logit, firth, ols, hc3)


class Score(NamedTuple):
    """A group's verdicts by both rules, with I5 in both; ``sizes`` are its trials per condition."""

    paper: dict[str, Judgement]
    robust: dict[str, Judgement]
    sizes: tuple[int, ...]

    @property
    def ceiling(self) -> dict[str, dict[str, float]]:
        """The human ceiling for the group's size."""
        return ceiling(self.sizes)


def ceiling(sizes: tuple[int, ...]) -> dict[str, dict[str, float]]:
    """Return by rule the shares of human data sets that pass each indicator, and ``I1-I4`` at once.

    It is linear between sizes of the shipped curve, which ``analysis/research/ceiling.py``
    computed. Without a trial in some condition there is no share.
    """
    shares: dict[str, dict[str, float]] = {"paper": {}, "robust": {}}
    if min(sizes):
        curves = published("human_ceiling").groupby(["rule", "indicator"], sort=False)
        for (rule, indicator), curve in curves:
            shares[rule][indicator] = float(np.interp(np.mean(sizes), curve["n"], curve["share"]))
    return shares


def total(judged: dict[str, Judgement]) -> str | None:
    """Return how many indicators hold, ``3 of 4``; None where none can be judged."""
    known = [verdict.passed for verdict in judged.values() if verdict.passed is not None]
    return f"{sum(known)} of {len(known)}" if known else None


@remembered
def score(study: StudyResults, group: Group) -> Score:
    """Judge a group's indicators."""
    fit = fits(group)
    paper = judge(fit.logit, fit.ols, robust=False)
    robust = judge(fit.firth, fit.hc3, robust=True)
    if not group.measured:
        row = published("paper_ablation_qualitative").query("driver == 'human'").iloc[0]
        for name in ("I3", "I4"):
            paper[name] = Judgement(bool(row[name.lower()]), PUBLISHED)
        paper["I5"] = Judgement(bool(row["i5"]), BY_EYE)
        robust["I5"] = Judgement(None, BY_EYE)
    elif group.caution:
        caution = Fact(Why.CAUTION, (group.caution,))
        paper = robust = dict.fromkeys(INDICATORS, Judgement(None, caution))
    else:
        # The paper judged by eye: there is no rule to apply, whatever is driven.
        paper["I5"], robust["I5"] = Judgement(None), piecewise_constant(study, group)
    return Score(paper, robust, group.sizes)
