"""Are a driver's speeds as intermittent as the humans'? Indicator I5, in human standard deviations.

A trial counts once, with the mean gain (see ``intermittency``) of its vehicles that acted. The
difference from the humans is taken within conditions, as another mix of conditions is none. A
driver is like the humans where the whole 95 % interval lies within the margin, and unlike them
where all of it lies beyond (an equivalence test; Schuirmann 1987): otherwise nothing is shown.
"""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from math import hypot

import pandas as pd
from scipy import stats

from analysis.data.study import ENOUGH_PER_CONDITION, Group, Study, of_group
from analysis.stats.indicators import Verdict
from analysis.stats.intervals import LEVEL, Estimate, mean

# Half a standard deviation is a medium effect (Cohen 1988): the distributions overlap by 80 %.
MARGIN_SD = 0.5
NO_ACTION = "no finished trial with control action"


@cache
def gains(study: Study, group: Group) -> pd.DataFrame:
    """One row a finished trial: condition, pair, ``steady`` (nobody acted), ``gain`` or NaN."""
    trials = group.finished[["trial_id", "spec_hash", "condition", "pair"]]
    by_trial = of_group(study.profiles, group, trials).groupby("trial_id")
    found = by_trial.agg(steady=("steady", "all"), gain=("gain", "mean"))
    return trials.drop(columns="spec_hash").merge(found, left_on="trial_id", right_index=True)


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
    apart = driver["gain"] - driver["condition"].map(usual)
    return _scaled(mean(apart.to_numpy(float)), mean(_independent(human, "apart")), spread)


def _scaled(driver: Estimate, pairs: Estimate, spread: float) -> Estimate:
    """``driver`` in units of ``spread``, with the uncertainty of both means (Welch 1947)."""
    if not spread or driver.value is None:
        return Estimate(None, None, None, driver.n)
    value = driver.value / spread
    if driver.low is None or pairs.low is None:
        return Estimate(value, None, None, driver.n)
    errors = [(_error(part), part.n - 1) for part in (driver, pairs)]
    error = hypot(*(one for one, _ in errors))
    if not error:
        return Estimate(value, value, value, driver.n)
    freedom = error**4 / sum(one**4 / n for one, n in errors)
    half = float(stats.t.ppf((1 + LEVEL) / 2, freedom)) * error / spread
    return Estimate(value, value - half, value + half, driver.n)


def _error(found: Estimate) -> float:
    """The standard error that an interval of ``mean`` came from."""
    assert found.value is not None
    assert found.high is not None
    return (found.high - found.value) / float(stats.t.ppf((1 + LEVEL) / 2, found.n - 1))


def _independent(trials: pd.DataFrame, column: str) -> pd.Series:
    """Values that do not hang together: of trials, or the means of human pairs."""
    return trials.groupby(trials["pair"].fillna(trials["trial_id"]))[column].mean()


def likeness(study: Study, group: Group) -> Verdict:
    """I5 of a driver: whether its accelerations are held as humans hold theirs."""
    if gains(study, group)["gain"].isna().all():
        return Verdict(None, None, NO_ACTION)
    if not study.human.measured:
        return Verdict(None, None, "no human traces to compare with: the number alone")
    if not study.calibrated:
        return Verdict(
            None,
            None,
            f"fewer than {ENOUGH_PER_CONDITION} human traces in a condition: the number alone",
        )
    return judged(difference(study, group))


def judged(found: Estimate) -> Verdict:
    """Whether a difference in human standard deviations lies within the margin."""
    if found.value is None and found.n:
        return Verdict(None, None, "human trials of a condition are alike: no spread to compare by")
    if found.low is None or found.high is None:
        return Verdict(None, None, "too few trials or human pairs to compare")
    if found.low > -MARGIN_SD and found.high < MARGIN_SD:
        return Verdict(True)
    if found.low > MARGIN_SD or found.high < -MARGIN_SD:
        return Verdict(False)
    interval = f"{found.low:.2f} to {found.high:.2f} SD"
    return Verdict(None, None, f"{interval} from the humans, which settles nothing")
