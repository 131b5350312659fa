"""Are a driver's speeds as intermittent as the humans'? Indicator I5, in human standard deviations.

A trial counts once, with the mean gain (see ``intermittency``) of its vehicles that acted. The
difference from the humans is taken within conditions, as another mix of conditions is none. A
driver is like the humans where the whole 95 % interval lies within the margin, and unlike them
where all of it lies beyond (an equivalence test; Schuirmann 1987): otherwise nothing is shown.
"""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from analysis.data.study import ENOUGH_PER_CONDITION, Group, Study
from analysis.stats import intervals
from analysis.stats.indicators import Verdict
from analysis.stats.intervals import Estimate, finite, mean, standard_error

Array = NDArray[np.float64]

# Half a standard deviation is a medium effect (Cohen 1988): the distributions overlap by 80 %.
MARGIN_SD = 0.5
NO_ACTION = "no finished trial with control action"


@cache
def gains(study: Study, group: Group) -> pd.DataFrame:
    """One row a finished trial: condition, pair, ``steady`` (nobody acted), ``gain`` or NaN."""
    trials = group.finished[["trial_id", "condition", "pair"]]
    by_trial = study.profiles_of(group).groupby("trial_id")
    found = by_trial.agg(steady=("steady", "all"), gain=("gain", "mean"))
    return trials.merge(found, left_on="trial_id", right_index=True)


def mean_gain(study: Study, group: Group) -> Estimate:
    """The mean gain of a group's trials; that of humans over the means of their pairs."""
    trials = gains(study, group).dropna(subset="gain")
    return replace(mean(_independent(trials, "gain")), n=len(trials))


def difference(study: Study, group: Group) -> Estimate:
    """The mean gain less that of humans in the same conditions, in human standard deviations."""
    return compared(gains(study, group), gains(study, study.human))


def compared(driver: pd.DataFrame, human: pd.DataFrame) -> Estimate:
    """The difference between rows of ``gains``, with Welch's interval over trials and pairs.

    The standard deviation is that of human trials within conditions.
    """
    driver, human = driver.dropna(subset="gain"), human.dropna(subset="gain")
    usual = human.groupby("condition")["gain"].mean()
    human = human.assign(apart=human["gain"] - human["condition"].map(usual))
    spread = float((human["apart"] ** 2).sum() / max(len(human) - len(usual), 1)) ** 0.5
    apart = (driver["gain"] - driver["condition"].map(usual)).to_numpy(float)
    return _in_spreads(finite(apart), finite(_independent(human, "apart")), spread)


def _in_spreads(driver: Array, pairs: Array, spread: float) -> Estimate:
    """The mean of ``driver`` in units of ``spread``, with the uncertainty of both means."""
    n = len(driver)
    if not spread or not n:
        return Estimate(None, None, None, n)
    value = float(driver.mean()) / spread
    if min(n, len(pairs)) < 2:
        return Estimate(value, None, None, n)
    errors = ((standard_error(part) / spread, len(part) - 1) for part in (driver, pairs))
    found = intervals.difference(value, *errors)
    low, high = (found and found.bounds()) or (value, value)
    return Estimate(value, low, high, n)


def _independent(trials: pd.DataFrame, column: str) -> Array:
    """Values that do not hang together: of trials, or the means of human pairs."""
    units = trials.groupby(trials["pair"].fillna(trials["trial_id"]))
    return np.asarray(units[column].mean(), dtype=float)


def likeness(study: Study, group: Group) -> Verdict:
    """I5 of a driver: whether its accelerations are held as humans hold theirs."""
    if gains(study, group)["gain"].isna().all():
        return Verdict(None, NO_ACTION)
    if not study.human.measured:
        return Verdict(None, "no human traces to compare with: the number alone")
    if not study.calibrated:
        return Verdict(
            None,
            f"fewer than {ENOUGH_PER_CONDITION} human traces in a condition: the number alone",
        )
    return judged(difference(study, group))


def judged(found: Estimate) -> Verdict:
    """Whether a difference in human standard deviations lies within the margin."""
    if found.value is None and found.n:
        return Verdict(None, "human trials of a condition are alike: no spread to compare by")
    if found.low is None or found.high is None:
        return Verdict(None, "too few trials or human pairs to compare")
    if found.low > -MARGIN_SD and found.high < MARGIN_SD:
        return Verdict(True)
    if found.low > MARGIN_SD or found.high < -MARGIN_SD:
        return Verdict(False)
    interval = f"{found.low:.2f} to {found.high:.2f} SD"
    return Verdict(None, f"{interval} from the humans, which settles nothing")
