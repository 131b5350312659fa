"""The levels of factors, each pooled over all other factors, and how far they are apart."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, replace
from functools import cache
from math import isnan

import pandas as pd

from merge_runner_analysis.data.study import Group, Study, in_one_study, levels_of
from merge_runner_analysis.metrics import Metric
from merge_runner_analysis.stats.contrasts import (
    contrast_cells,
    contrast_means,
    interaction_of_means,
    interaction_of_rates,
    shared_cells,
    slope_within,
)
from merge_runner_analysis.stats.intervals import Difference
from merge_runner_analysis.stats.measures import trials_of, undecided

Cell = tuple[str, ...]


@dataclass(frozen=True, eq=False)
class Level:
    """A level of a factor: the ids of its groups, and their trials as one group.

    The trials have a column ``cell``: their condition and the levels of all other factors.
    ``posing`` is what is said of scripted stand-ins; the ``mark`` tells their level from others'.
    ``at`` is the level of another factor that all of its trials have, if it is shown by that one.
    """

    factor: str
    name: str
    groups: tuple[str, ...]
    pooled: Group
    posing: str = ""
    mark: str = ""
    at: str = ""

    @property
    def id(self) -> str:
        """``temperature=0.2``, or ``opponent=idm/temperature=0.2``."""
        return f"{self.at}/" * bool(self.at) + f"{self.factor}={self.name}{self.mark}"

    @property
    def cells(self) -> Counter[Cell]:
        """How many trials each cell has that ended."""
        return Counter(self.pooled.ended["cell"])


@cache
def levels_by_factor(study: Study, by: str = "", at: str = "") -> list[list[Level]]:
    """The levels of each factor in which the trials of drivers differ, the reference first.

    Trials of scripted stand-ins are never pooled with others. Where there are several levels of the
    factor ``by``, the trials are those ``at`` one of them.
    """
    chosen = [group for group in study.models if not by or group.levels.get(by) == at]
    kinds = [[g for g in chosen if g.scripted == scripted] for scripted in (False, True)]
    apart = any(g.scripted for g in study.models) and not all(g.scripted for g in study.models)
    return [
        [_level(groups, factor, name, by, apart=apart) for name in levels]
        for groups in kinds
        for factor, levels in levels_of(groups, study.order).items()
        if len(levels) > 1
    ]


def _level(every: list[Group], factor: str, name: str, by: str, *, apart: bool) -> Level:
    groups = [group for group in every if group.levels.get(factor) == name]
    parts = []
    for group in groups:
        others = [f"{n}={level}" for n, level in group.levels.items() if n not in (factor, by)]
        others += [group.mark.strip()] * bool(group.mark)  # another setting of the task
        cells = [(condition, *others) for condition in group.trials["condition"]]
        parts.append(group.trials.assign(cell=pd.Series(cells, group.trials.index, dtype=object)))
    pooled = replace(groups[0], trials=pd.concat(parts, ignore_index=True))
    said = {group.posing for group in groups}
    posing = said.pop() if len(said) == 1 else "scripted stand-ins"
    mark = " [scripted]" if apart and posing else ""
    at = f"{by}={groups[0].levels[by]}" if by else ""
    return Level(factor, name, tuple(group.id for group in groups), pooled, posing, mark, at)


def difference(study: Study, level: Level, first: Level, metric: Metric) -> Difference | None:
    """A level minus the first one, within the cells that both have.

    None where these are of several studies, share no cell or have undecided trials; and for
    medians, which have no test.
    """
    frames = _by_cell(study, metric, level, first)
    if frames is None or metric.estimator == "median":
        return None
    one, other = frames
    if metric.rate:
        both = shared_cells(one, other, metric.column)
        return contrast_cells(both) if both else None
    return contrast_means(one, other, metric.column)


def difference_of_medians(study: Study, level: Level, first: Level, metric: Metric) -> float | None:
    """A level's median minus that of the first one, in the cells that both have."""
    frames = _in_shared_cells(study, metric, level, first)
    if frames is None:
        return None
    one, other = (frame[metric.column].median() for frame in frames)
    return None if isnan(one) or isnan(other) else float(one - other)


def interaction(
    study: Study, pair: tuple[Level, Level], others: tuple[Level, Level], metric: Metric
) -> Difference | None:
    """How far the difference of a ``pair`` of levels differs from that of two ``others``.

    It is taken in the cells that all four have; None as in ``difference``.
    """
    frames = _in_shared_cells(study, metric, *pair, *others)
    if frames is None or metric.estimator == "median":
        return None
    a, b, c, d = frames
    if metric.rate:
        one, other = shared_cells(a, b, metric.column), shared_cells(c, d, metric.column)
        return interaction_of_rates(one, other) if one and other else None
    return interaction_of_means(
        slope_within(a, b, metric.column), slope_within(c, d, metric.column)
    )


def _by_cell(study: Study, metric: Metric, *levels: Level) -> list[pd.DataFrame] | None:
    """The trials of each level that have a measure, with their cell as condition.

    None where these are of several studies or have undecided trials.
    """
    groups = [level.pooled for level in levels]
    if not in_one_study(study, *groups) or any(undecided(group, metric) for group in groups):
        return None
    frames = [trials_of(group, metric).dropna(subset=[metric.column]) for group in groups]
    return [frame.assign(condition=frame["cell"]) for frame in frames]


def _in_shared_cells(study: Study, metric: Metric, *levels: Level) -> list[pd.DataFrame] | None:
    """The same in the cells that all levels have."""
    frames = _by_cell(study, metric, *levels)
    if frames is None:
        return None
    shared = set.intersection(*(set(frame["condition"]) for frame in frames))
    return [frame[frame["condition"].isin(shared)] for frame in frames]


def balance(levels: list[Level]) -> str:
    """Whether all levels of a factor have the same cells, equally often; else which they lack."""
    found = {level.name: level.cells for level in levels}
    every = sorted({cell for cells in found.values() for cell in cells})
    lacking = {name: [cell for cell in every if cell not in cells] for name, cells in found.items()}
    if any(lacking.values()):
        said = (
            f"{name} lacks {len(cells)} of {len(every)} cells ({_shown(cells)})"
            for name, cells in lacking.items()
            if cells
        )
        return f"not balanced, so that values over all trials are confounded: {'; '.join(said)}"
    if any(len({cells[cell] for cells in found.values()}) > 1 for cell in every):
        return (
            f"every level has all {len(every)} cells, but not equally many trials in each, so that "
            "values over all trials weigh these differently"
        )
    return f"balanced: every level has the same {len(every)} cells equally often"


def _shown(cells: list[Cell], most: int = 3) -> str:
    more = f" and {len(cells) - most} more" if len(cells) > most else ""
    return "; ".join(" ".join(cell) for cell in cells[:most]) + more
