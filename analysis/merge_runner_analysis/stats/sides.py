"""Share of going first, counted for both sides, where one of two equal drivers is given something.

A trial in which both get the same counts half for the left driver and half for the right one.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import pandas as pd

from merge_runner_analysis.cache import remembered
from merge_runner_analysis.metrics import LEFT_FIRST, Metric
from merge_runner_analysis.stats.estimate import Estimate
from merge_runner_analysis.stats.levels import Cell, Level
from merge_runner_analysis.stats.measures import estimate
from merge_runner_analysis.study import StudyResults

MIRRORED = " mirrored"  # ends the name of a condition as the driver on the right sees it


@remembered
def one_sided(study: StudyResults) -> bool:
    """Return whether in some trials only one of two equal drivers is given something."""
    return any(
        (group.trials["focal"].notna() & _of_equals(group.trials)).any() for group in study.models
    )


@remembered
def level_estimate(study: StudyResults, level: Level, metric: Metric) -> Estimate:
    """Return a metric of a level's trials; those that count for both sides have no variance."""
    group = level.pooled
    trials = group.trials
    same = trials[metric.column].notna() & have_same_prompts(trials)
    if metric is not LEFT_FIRST or not one_sided(study) or not same.any():
        return estimate(group, metric)
    varying = estimate(replace(group, trials=trials[~same]), metric)
    n = varying.n + int(same.sum())
    if varying.value is None:
        return Estimate(50.0, n=n)
    value, low, high = (
        None if of is None else 50 + (of - 50) * varying.n / n
        for of in (varying.value, varying.low, varying.high)
    )
    return Estimate(value, low, high, n)


def cells_seen(study: StudyResults, level: Level) -> set[Cell]:
    """Return the cells of a level's ended trials as who goes first has them.

    Where sides count, a cell has the side, and equal drivers the mirrored cells, too.
    """
    trials = level.pooled.ended
    if not one_sided(study):
        return {*trials["cell"]}
    same = trials.loc[have_same_prompts(trials), "cell"].unique()
    images = {(_mirrored(study, condition), *others, "right") for condition, *others in same}
    return images | {(*cell, ego) for cell, ego in zip(trials["cell"], trials["ego"], strict=True)}


def have_same_prompts(trials: pd.DataFrame) -> pd.Series:
    """Return by trial whether two equal drivers are given the same."""
    return trials["focal"].isna() & _of_equals(trials)


def _of_equals(trials: pd.DataFrame) -> pd.Series:
    return trials["model_left"] == trials["model_right"]


def from_both_sides(study: StudyResults, frame: pd.DataFrame, trials: pd.DataFrame) -> pd.DataFrame:
    """Return who goes first by cell and side, so that no side is favoured."""
    trials = trials.loc[frame.index]
    sided = [(*cell, ego) for cell, ego in zip(frame["condition"], trials["ego"], strict=True)]
    images = [(_mirrored(study, cell[0]), *cell[1:], "right") for cell in frame["condition"]]
    cells, mirrored = (pd.Series(names, frame.index, dtype=object) for names in (sided, images))
    frame = frame.assign(condition=cells, value=frame["value"].astype(float))
    return read_twice(frame, mirrored.where(have_same_prompts(trials)))


def read_twice(frame: pd.DataFrame, images: pd.Series) -> pd.DataFrame:
    """Return trials by cell; one with an image also counts there, with the opposite outcome."""
    right = frame.assign(condition=images, value=1 - frame["value"])[images.notna()]
    return pd.concat([frame, right])


def mirrored_name(condition: str, conditions: Mapping[str, tuple[float, float]]) -> str:
    """Return the name of a mirrored condition, by headway in m and relative velocity in m/s."""
    headway_m, velocity_mps = conditions[condition]
    numbers = (0 - headway_m, 0 - velocity_mps)
    if numbers == (headway_m, velocity_mps):
        return condition
    return min((n for n, at in conditions.items() if at == numbers), default=condition + MIRRORED)


@remembered
def _mirrored(study: StudyResults, condition: str) -> str:
    return mirrored_name(condition, study.conditions)
