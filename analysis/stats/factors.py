"""The levels of factors, each pooled over all other factors, and how far they are apart."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, replace
from functools import cache

import pandas as pd

from analysis.data.study import Group, Study, levels_of
from analysis.metrics import Metric
from analysis.stats.contrasts import contrast_means, contrast_rates
from analysis.stats.intervals import Difference
from analysis.stats.measures import counts, trials_of

Cell = tuple[str, ...]


@dataclass(frozen=True, eq=False)
class Level:
    """A level of a factor: the ids of its groups, and their trials as one group.

    The trials have a column ``cell``: their condition and the levels of all other factors.
    ``posing`` is what is said of scripted stand-ins; the ``mark`` tells their level from others'.
    """

    factor: str
    name: str
    groups: tuple[str, ...]
    pooled: Group
    posing: str = ""
    mark: str = ""

    @property
    def id(self) -> str:
        """``temperature=0.2``."""
        return f"{self.factor}={self.name}{self.mark}"

    @property
    def cells(self) -> Counter[Cell]:
        """How many trials each cell has that ended."""
        return Counter(self.pooled.ended["cell"])


@cache
def levels_by_factor(study: Study) -> list[list[Level]]:
    """The levels of each factor in which the trials of drivers differ.

    Trials of scripted stand-ins are never pooled with others.
    """
    kinds = [[g for g in study.models if g.scripted == scripted] for scripted in (False, True)]
    apart = all(kinds)
    return [
        [_level(groups, factor, name, apart=apart) for name in levels]
        for groups in kinds
        for factor, levels in levels_of(groups).items()
        if len(levels) > 1
    ]


def _level(every: list[Group], factor: str, name: str, *, apart: bool) -> Level:
    groups = [group for group in every if group.levels.get(factor) == name]
    parts = []
    for group in groups:
        others = tuple(f"{n}={level}" for n, level in group.levels.items() if n != factor)
        cells = [(condition, *others) for condition in group.trials["condition"]]
        parts.append(group.trials.assign(cell=pd.Series(cells, group.trials.index, dtype=object)))
    pooled = replace(groups[0], trials=pd.concat(parts, ignore_index=True))
    said = {group.posing for group in groups}
    posing = said.pop() if len(said) == 1 else "scripted stand-ins"
    mark = " [scripted]" if apart and posing else ""
    return Level(factor, name, tuple(group.id for group in groups), pooled, posing, mark)


def difference(level: Level, first: Level, metric: Metric) -> Difference | None:
    """A level minus the first one: rates over all trials, means within cells.

    None for medians, which have no test here, and where nothing can be compared.
    """
    if metric.rate:
        rates = counts(level.pooled, metric), counts(first.pooled, metric)
        return contrast_rates(*rates) if all(n for _, n in rates) else None
    if metric.estimator == "median":
        return None
    trials = (trials_of(each.pooled, metric) for each in (level, first))
    one, other = (each.assign(condition=each["cell"]) for each in trials)
    return contrast_means(one, other, metric.column)


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
        return f"not balanced, so that pooled values are confounded: {'; '.join(said)}"
    if any(len({cells[cell] for cells in found.values()}) > 1 for cell in every):
        return (
            f"every level has all {len(every)} cells, but not equally many trials in each, so that "
            "pooled values weigh these differently"
        )
    return f"balanced: every level has the same {len(every)} cells equally often"


def _shown(cells: list[Cell], most: int = 3) -> str:
    more = f" and {len(cells) - most} more" if len(cells) > most else ""
    return "; ".join(" ".join(cell) for cell in cells[:most]) + more
