"""Is the acceleration piecewise constant, and as much as the humans'? Indicator I5.

A trial counts once, with the mean gain (see ``intermittency``) of its vehicles that acted. The test
is one-sided: I5 holds where the whole 95 % interval of the mean gain lies above 0. How like the
humans a driver is in it is a number beside that, in human standard deviations, which decides
nothing. That difference is taken within conditions, as another mix of conditions is none.
"""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import pandas as pd

from merge_runner_analysis.data.study import Group, Study
from merge_runner_analysis.stats.indicators import Verdict
from merge_runner_analysis.stats.intervals import Estimate, difference, mean

NO_ACTION = "no finished trial with control action"


@cache
def gains(study: Study, group: Group) -> pd.DataFrame:
    """One row a finished trial: condition, pair, ``steady`` (nobody acted), and ``gain`` or NaN."""
    trials = group.finished[["trial_id", "condition", "pair"]]
    by_trial = study.profiles_of(group).groupby("trial_id")
    found = by_trial.agg(steady=("steady", "all"), gain=("gain", "mean"))
    return trials.merge(found, left_on="trial_id", right_index=True)


def mean_gain(study: Study, group: Group) -> Estimate:
    """The mean gain of a group's trials; that of humans over the means of their pairs."""
    trials = gains(study, group).dropna(subset="gain")
    return replace(mean(_independent(trials, "gain")), n=len(trials))


def less_humans(study: Study, group: Group) -> Estimate | None:
    """The mean gain less that of humans in the same conditions, in human standard deviations.

    None for the humans, and without a spread of human trials in every condition.
    """
    if group is study.human or not study.calibrated:
        return None
    return compared(gains(study, group), gains(study, study.human))


def compared(driver: pd.DataFrame, human: pd.DataFrame) -> Estimate:
    """The difference between rows of ``gains``, with Welch's interval over trials and pairs.

    The standard deviation is that of human trials within conditions.
    """
    driver, human = driver.dropna(subset="gain"), human.dropna(subset="gain")
    usual = human.groupby("condition")["gain"].mean()
    human = human.assign(apart=human["gain"] - human["condition"].map(usual))
    spread = float((human["apart"] ** 2).sum() / max(len(human) - len(usual), 1)) ** 0.5
    apart = (driver["gain"] - driver["condition"].map(usual)).dropna()
    if not spread:
        return Estimate(None, None, None, len(apart))
    own, pairs = mean(apart / spread), mean(_independent(human, "apart") / spread)
    if own.value is None or own.se is None or pairs.se is None:
        return Estimate(own.value, None, None, own.n)
    found = difference(own, replace(pairs, value=0.0))
    low, high = (found and found.bounds()) or (own.value, own.value)
    return replace(own, low=low, high=high)


def _independent(trials: pd.DataFrame, column: str) -> pd.Series:
    """Values that do not hang together: of trials, or the means of human pairs."""
    return trials.groupby(trials["pair"].fillna(trials["trial_id"]))[column].mean()


def piecewise_constant(study: Study, group: Group) -> Verdict:
    """I5: whether the accelerations of a group are held and jump, rather than move."""
    found = mean_gain(study, group)
    if not found.n:
        return Verdict(None, NO_ACTION)
    if found.low is None:
        return Verdict(None, "a single trial, or a single human pair, with control action")
    return Verdict(found.low > 0)
