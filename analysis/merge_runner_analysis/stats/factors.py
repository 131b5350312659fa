"""The levels of factors, each pooled over all other factors, and how far they are apart."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from math import isnan

import pandas as pd

from merge_runner_analysis.cache import remembered
from merge_runner_analysis.frames import KEYS
from merge_runner_analysis.grouping import Group, levels_of
from merge_runner_analysis.metrics import Metric
from merge_runner_analysis.stats.contrasts import trials_by_cell
from merge_runner_analysis.study import Study


@dataclass(frozen=True, eq=False)
class Level:
    """A level of a factor: the ids of its groups, and their trials as one group without copies.

    The trials have a column ``cell``: their condition and the levels of all other factors. Cells
    in which programs play the same trials are one cell. ``pooled.whole`` has the copies, too.
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

    @cached_property
    def cells(self) -> set[tuple[str, ...]]:
        """The cells of its trials that ended."""
        return {*self.pooled.ended["cell"]}

    @cached_property
    def copies(self) -> tuple[tuple[str, str], ...]:
        """The trials of its groups that are left out as copies (trial_id, spec_hash)."""
        copies = self.pooled.stored.trials.drop(index=self.pooled.trials.index)
        left_out = copies.loc[copies["group"].isin(self.groups), KEYS]
        return tuple(left_out.itertuples(index=False, name=None))


@remembered
def levels_by_factor(study: Study, by: str = "", at: str = "") -> list[list[Level]]:
    """The levels of each factor in which the trials of drivers differ, the reference first.

    Trials of scripted stand-ins are never pooled with others. Where there are several levels of the
    factor ``by``, the trials are those ``at`` one of them.
    """
    chosen = [group for group in study.models if not by or group.levels.get(by) == at]
    kinds = [[g for g in chosen if g.scripted == scripted] for scripted in (False, True)]
    apart = any(g.scripted for g in study.models) and not all(g.scripted for g in study.models)
    return [
        _distinct([_level(groups, factor, name, by, apart=apart) for name in levels])
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
        cells_of = pd.Series(cells, group.trials.index, dtype=object)
        parts.append(group.trials.assign(cell=cells_of, group=group.id))
    pooled = replace(groups[0], trials=pd.concat(parts, ignore_index=True))
    said = {group.posing for group in groups}
    posing = said.pop() if len(said) == 1 else "scripted stand-ins"
    mark = " [scripted]" if apart and posing else ""
    at = f"{by}={groups[0].levels[by]}" if by else ""
    return Level(factor, name, tuple(group.id for group in groups), pooled, posing, mark, at)


def _distinct(levels: list[Level]) -> list[Level]:
    """The levels, each without copies of trials, and with the cells that share these as one."""
    names: dict[tuple[str, ...], tuple[str, ...]] = {}

    def first(cell: tuple[str, ...]) -> tuple[str, ...]:
        while (before := names.get(cell, cell)) != cell:
            cell = before
        return cell

    for level in levels:
        for _, cells in level.pooled.trials.groupby(["condition", "way"])["cell"]:
            same = sorted({first(cell) for cell in cells})
            names |= dict.fromkeys(same[1:], same[0])
    return [_without_copies(level, first) for level in levels]


def _without_copies(level: Level, first: Callable[[tuple[str, ...]], tuple[str, ...]]) -> Level:
    every = level.pooled.trials
    every = every.assign(cell=pd.Series([first(cell) for cell in every["cell"]], dtype=object))
    kept = every.drop_duplicates(["condition", "way"])
    pooled = replace(level.pooled, trials=kept, whole=replace(level.pooled, trials=every))
    return replace(level, groups=tuple(kept["group"].unique()), pooled=pooled)


def difference_of_medians(study: Study, metric: Metric, level: Level, first: Level) -> float | None:
    """A level's median minus that of the first one, in the cells that both have."""
    groups = (level.pooled, first.pooled)
    medians = [
        frame[metric.column].median()
        for frame in trials_by_cell(study, groups, metric, "cell", shared=True)
    ]
    return None if not medians or isnan(sum(medians)) else float(medians[0] - medians[1])


def balance(levels: list[Level]) -> str:
    """Whether all levels of a factor have the same cells."""
    found = {level.name: level.cells for level in levels}
    every = set().union(*found.values())
    lacking = [
        f"{name} lacks {len(every) - len(cells)} of {len(every)} cells"
        for name, cells in found.items()
        if len(cells) < len(every)
    ]
    if lacking:
        return f"not balanced, so that values over all trials are confounded: {'; '.join(lacking)}"
    return f"every level has the same {len(every)} cells"
