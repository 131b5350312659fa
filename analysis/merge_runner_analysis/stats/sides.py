"""Who goes first, read from both sides: where one of two equal drivers is given something.

The other trials, in which both are given the same, have no driver that is asked about: each is read
from the left and from the right, and counts half for either.
"""

from __future__ import annotations

from dataclasses import replace

import pandas as pd

from merge_runner_analysis.cache import remembered
from merge_runner_analysis.metrics import LEFT_FIRST, Metric
from merge_runner_analysis.stats.estimate import Estimate
from merge_runner_analysis.stats.levels import Cell, Level
from merge_runner_analysis.stats.measures import estimate
from merge_runner_analysis.study import Study


@remembered
def one_sided(study: Study) -> bool:
    """Whether in some trials one driver is given what the other, who is equal to it, is not."""
    return any(
        (group.trials["focal"].notna() & _of_equals(group.trials)).any() for group in study.models
    )


@remembered
def level_estimate(study: Study, level: Level, metric: Metric) -> Estimate:
    """A metric of all trials of a level, with its 95 % interval.

    Who goes first is read from both sides where equal drivers are told the same: each of these
    trials counts half for either, and has no variance.
    """
    group = level.pooled
    trials = group.trials
    same = trials[metric.column].notna() & _told_the_same(trials)
    if metric is not LEFT_FIRST or not one_sided(study) or not same.any():
        return estimate(group, metric)
    own = estimate(replace(group, trials=trials[~same]), metric)
    n = own.n + int(same.sum())
    if own.value is None:
        return Estimate(50.0, n=n)
    value, low, high = (
        None if of is None else 50 + (of - 50) * own.n / n for of in (own.value, own.low, own.high)
    )
    return Estimate(value, low, high, n)


def cells_seen(study: Study, level: Level) -> set[Cell]:
    """The cells of its trials that ended; where both drivers are told the same, of both sides."""
    trials = level.pooled.ended
    seen = {*trials["cell"]}
    if one_sided(study):
        same = trials.loc[_told_the_same(trials), "cell"].unique()
        seen |= {(_image(study, condition), *others) for condition, *others in same}
    return seen


def _told_the_same(trials: pd.DataFrame) -> pd.Series:
    return trials["focal"].isna() & _of_equals(trials)


def _of_equals(trials: pd.DataFrame) -> pd.Series:
    return trials["model_left"] == trials["model_right"]


def from_both_sides(study: Study, frame: pd.DataFrame, trials: pd.DataFrame) -> pd.DataFrame:
    """Who goes first, by cell and side; trials of two that are given the same read from both.

    So whoever is given something on the left is compared with the left ones who are not, and on the
    right with the right ones: no side is favoured. The readings of a trial are opposite, and the
    sum of both does not vary.
    """
    trials = trials.loc[frame.index]
    same = _told_the_same(trials)
    sides = _with_side(frame["condition"], trials["ego"])
    left = frame.assign(condition=sides, varies=~same)
    images = {name: _image(study, name) for name in trials["condition"].unique()}
    named = [(images[cell[0]], *cell[1:]) for cell in frame.loc[same, "condition"]]
    cells = pd.Series(named, frame.index[same], dtype=object)
    right = pd.DataFrame(
        {
            "condition": _with_side(cells, pd.Series("right", cells.index)),
            "value": ~frame.loc[same, "value"].astype(bool),
            "varies": False,
        }
    )
    return pd.concat([left, right])


def _with_side(cells: pd.Series, sides: pd.Series) -> pd.Series:
    named = [(*cell, side) for cell, side in zip(cells, sides, strict=True)]
    return pd.Series(named, cells.index, dtype=object)


def _image(study: Study, condition: str) -> str:
    """A condition as the driver on the right sees it."""
    headway_m, velocity_mps = study.conditions[condition]
    mirrored = (0 - headway_m, 0 - velocity_mps)
    if mirrored == (headway_m, velocity_mps):
        return condition
    found = sorted(name for name, numbers in study.conditions.items() if numbers == mirrored)
    return found[0] if found else f"{condition} mirrored"
