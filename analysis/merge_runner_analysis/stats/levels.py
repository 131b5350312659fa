"""The levels of factors, and their trials by cell: a condition and the other levels."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import combinations

import pandas as pd

from merge_runner.records import SIDES
from merge_runner_analysis.cache import remembered
from merge_runner_analysis.frames import KEYS
from merge_runner_analysis.grouping import Group, levels_of
from merge_runner_analysis.study import StudyResults
from merge_runner_analysis.wording import TIMES

# With this factor prompts are compared driver by driver: its levels pool those of all others.
DRIVER = "driver"
Cell = tuple[str, ...]


@dataclass(frozen=True, eq=False)
class Level:
    """A level of a factor: the ids of its groups, and their trials as one group without copies.

    The trials have a column ``cell``; cells with copies of each other are one. ``posing`` is the
    label of mock models, ``mark`` distinguishes their level, and ``at`` is a level of another
    factor.
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
    def keys(self) -> list[tuple[str, str]]:
        """The key of each trial without copies."""
        return [*self.pooled.trials[KEYS].itertuples(index=False, name=None)]

    @cached_property
    def copies(self) -> tuple[tuple[str, str], ...]:
        """The trials of its groups that are left out as copies (trial_id, spec_hash)."""
        copies = self.pooled.stored.trials.drop(index=self.pooled.trials.index)
        if copies.empty:
            return ()
        left_out = copies.loc[copies["group"].isin(self.groups), KEYS]
        return tuple(left_out.itertuples(index=False, name=None))


@remembered
def copied_cells(study: StudyResults, groups: tuple[Group, ...]) -> set[Cell]:
    """Return the cells in which programs do not read the groups' factor, so that trials are copies.

    A condition is never left out alone: the choice would depend on the outcomes there.
    """
    ways = [_ways(study, group) for group in groups]
    copied: set[Cell] = set()
    for first, second in combinations(ways, 2):
        for others in first.keys() & second.keys():
            if _are_copies(first[others], second[others]):
                copied |= {(name, *others) for name in first[others].keys() & second[others].keys()}
    return copied


@remembered
def _ways(study: StudyResults, group: Group) -> dict[Cell, dict[str, set[object]]]:
    """Return the distinct courses of trials, by the other factors' levels and by condition."""
    ways: dict[Cell, dict[str, set[object]]] = {}
    for (condition, *others), way in zip(group.ended["cell"], group.ended["way"], strict=True):
        ways.setdefault((*others,), {}).setdefault(condition, set()).add(way)
    return ways


def _are_copies(ways: Mapping[str, set[object]], others: Mapping[str, set[object]]) -> bool:
    """Return whether, in each shared condition, one's trials are all among the other's."""
    shared = ways.keys() & others.keys()
    return bool(shared) and all(
        ways[name] <= others[name] or others[name] <= ways[name] for name in shared
    )


@remembered
def copied_of_shared(study: StudyResults, *levels: Level) -> tuple[int, int]:
    """Return the numbers of copied cells and of all cells that levels share."""
    shared = set.intersection(*({*level.pooled.ended["cell"]} for level in levels))
    return len(shared & copied_cells(study, tuple(level.pooled for level in levels))), len(shared)


@remembered
def levels_by_factor(
    study: StudyResults, by: str = "", at: str = "", least: int = 2
) -> list[list[Level]]:
    """Return the levels of each factor that has at ``least`` this number, the reference first."""
    chosen = [group for group in study.models if not by or _level_of(group, by) == at]
    kinds = [[g for g in chosen if g.scripted == scripted] for scripted in (False, True)]
    apart = any(g.scripted for g in study.models) and not all(g.scripted for g in study.models)
    return [
        _distinct(study, [_level(groups, factor, name, by, apart=apart) for name in levels])
        for groups in kinds
        for factor, levels in levels_of(groups, study.order).items()
        if len(levels) >= least
    ]


def _level_of(group: Group, factor: str) -> str | None:
    return group.driver if factor == DRIVER else group.levels.get(factor)


def _level(every: list[Group], factor: str, name: str, by: str, *, apart: bool) -> Level:
    groups = [group for group in every if group.levels.get(factor) == name]
    texts = {group.posing for group in groups}
    posing = texts.pop() if len(texts) == 1 else "mock models"
    mark = " [scripted]" if apart and posing else ""
    at = f"{by}={_level_of(groups[0], by)}" if by else ""
    pooled = _with_cells(groups, {factor, by})
    return Level(factor, name, tuple(group.id for group in groups), pooled, posing, mark, at)


def _with_cells(groups: Sequence[Group], apart_from: set[str]) -> Group:
    """Return groups as one, with each trial's cell: condition and levels of the other factors."""
    parts = []
    for group in groups:
        others = [f"{n}={level}" for n, level in group.levels.items() if n not in apart_from]
        others += [group.mark.strip()] * bool(group.mark)  # another setting of the task
        conditions = group.trials["condition"]
        cells = {condition: (condition, *others) for condition in conditions.unique()}
        cells_of = pd.Series([*map(cells.get, conditions)], group.trials.index, dtype=object)
        parts.append(group.trials.assign(cell=cells_of, group=group.id))
    return replace(groups[0], trials=pd.concat(parts, ignore_index=True))


def crossing(study: StudyResults, factors: Sequence[str], levels: Mapping[str, str]) -> list[Level]:
    """Return the trials at levels of several factors; mock models get a separate level."""
    chosen = [g for g in study.models if all(_level_of(g, f) == at for f, at in levels.items())]
    crossed = []
    for scripted in sorted({group.scripted for group in chosen}):
        groups = [group for group in chosen if group.scripted == scripted]
        mark = " [scripted]" if scripted and len(groups) < len(chosen) else ""
        name = ", ".join(levels[factor] for factor in factors)
        pooled = _with_cells(groups, {*levels})
        ids = tuple(group.id for group in groups)
        crossed += _distinct(study, [Level(TIMES.join(factors), name, ids, pooled, mark=mark)])
    return crossed


def _distinct(study: StudyResults, levels: list[Level]) -> list[Level]:
    """Return the levels without copies of trials; cells that share copies become one."""
    names: dict[Cell, Cell] = {}

    def first(cell: Cell) -> Cell:
        while (before := names.get(cell, cell)) != cell:
            cell = before
        return cell

    for level in levels:
        for cells in _with_copies(study, level.pooled):
            same = sorted({first(cell) for cell in cells})
            names |= dict.fromkeys(same[1:], same[0])
    return [_without_copies(level, first) for level in levels]


def _with_copies(study: StudyResults, group: Group) -> Iterator[Iterable[Cell]]:
    """Yield cells that are copies of each other; of a mock model only if all trials are equal."""
    if not group.scripted:
        yield from (cells for _, cells in group.trials.groupby(["condition", "way"])["cell"])
        return
    for (levels, ways), (other_levels, other_ways) in combinations(_ways(study, group).items(), 2):
        if _are_copies(ways, other_ways):
            yield from (
                ((name, *levels), (name, *other_levels)) for name in ways.keys() | other_ways.keys()
            )


@remembered
def distinct(study: StudyResults, group: Group) -> Group:
    """Return a group with identical trials counted once; ``whole`` has the copies, too."""
    every = Level(DRIVER, group.id, (group.id,), _with_cells([group], set()))
    (level,) = _distinct(study, [every])
    return level.pooled if level.copies else group


def _without_copies(level: Level, first: Callable[[tuple[str, ...]], tuple[str, ...]]) -> Level:
    """Return the level with each trial once.

    If copies differ in the side of their ego, no driver read what the ego gets: then the kept trial
    has no ``focal`` side.
    """
    every = level.pooled.trials
    every = every.assign(cell=pd.Series([first(cell) for cell in every["cell"]], dtype=object))
    kept = every if every["way"].is_unique else _once(every, scripted=level.pooled.scripted)
    pooled = replace(level.pooled, trials=kept, whole=replace(level.pooled, trials=every))
    return replace(level, groups=tuple(kept["group"].unique()), pooled=pooled)


def _once(every: pd.DataFrame, *, scripted: bool) -> pd.DataFrame:
    """Return the trials once; a mock model's are copies only at equal levels of other factors."""
    others = pd.Series([" ".join(others) for _, *others in every["cell"]], every.index)
    way = every["way"] + (" " + others if scripted else "")
    for _, rows in every.groupby(others):
        left, right = ({*rows.loc[rows["ego"] == side, "way"]} for side in SIDES)
        if not (left <= right or right <= left):
            way = way.where(~way.index.isin(rows.index), way + " " + every["ego"])
    from_left = every.assign(way=way).sort_values("ego", kind="stable")
    kept = every.loc[from_left.drop_duplicates("way").index.sort_values()]
    both = every.groupby(way)["ego"].transform("nunique")[kept.index] > 1
    return kept.assign(focal=kept["focal"].mask(both))
