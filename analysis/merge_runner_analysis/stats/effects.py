"""What a factor changes: each of its levels against the reference, in every measure.

Levels are compared within the cells that both have: a condition with one level of each other
factor. A driver is a level of the factor ``model``; an interaction is a difference of differences,
in the cells that all four have.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import chain, combinations, product

import pandas as pd

from merge_runner.registry import in_use, require
from merge_runner.study.crossing import MODEL
from merge_runner.study.file import StudySource
from merge_runner_analysis.cache import remembered
from merge_runner_analysis.frames import KEYS
from merge_runner_analysis.grouping import Group, levels_of
from merge_runner_analysis.metrics import BOXES, COLLISIONS, LEFT_FIRST, METRICS, Metric
from merge_runner_analysis.stats.contrasts import (
    contrast_means,
    contrast_rates,
    corrected,
    difference_of_contrasts,
    means_within,
    shared_cells,
)
from merge_runner_analysis.stats.estimate import Estimate
from merge_runner_analysis.stats.intervals import difference
from merge_runner_analysis.stats.measures import estimate, linear, undecided
from merge_runner_analysis.study import Study, in_one_study
from merge_runner_analysis.wording import TIMES

# Shown by this one, prompts are compared driver by driver; a driver has all other levels in it.
DRIVER = "driver"
PRIMARY = "goes_first"  # in a study's file, and where none is named
Cell = tuple[str, ...]


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
    def copies(self) -> tuple[tuple[str, str], ...]:
        """The trials of its groups that are left out as copies (trial_id, spec_hash)."""
        copies = self.pooled.stored.trials.drop(index=self.pooled.trials.index)
        if copies.empty:
            return ()
        left_out = copies.loc[copies["group"].isin(self.groups), KEYS]
        return tuple(left_out.itertuples(index=False, name=None))


@dataclass(frozen=True, eq=False)
class Effect:
    """A level against the reference of its factor, in one measure, in the unit of that.

    ``at_level`` and ``at_reference`` are the estimates within the shared cells, in which the trials
    count without ``left_out``; their ``difference`` has its interval, p and detectable. Values are
    None where nothing is compared. Of an interaction the first two have no value but their trials.
    Of an interaction ``across`` are the same two levels at the reference of the other factor.
    ``p_corrected`` is by Holm's method, in the family that ``primary`` tells.
    """

    level: Level
    reference: Level
    metric: Metric
    at_level: Estimate
    at_reference: Estimate
    difference: Estimate
    left_out: tuple[tuple[str, str], ...] = ()
    across: tuple[Level, Level] | None = None
    primary: bool = False
    p_corrected: float | None = None

    @property
    def id(self) -> str:
        """``temperature=0.2/gap_m``, or ``opponent=idm/temperature=0.2/interaction/gap_m``."""
        middle = "/interaction" if self.across else ""
        return f"{self.level.id}{middle}/{self.metric.name}"

    @property
    def factor(self) -> str:
        """``temperature``, or of an interaction both, joined by TIMES."""
        by = self.level.at.partition("=")[0]
        return f"{self.level.factor}{TIMES}{by}" if self.across else self.level.factor

    @property
    def key(self) -> tuple[frozenset[str], str, str]:
        """What is compared, whichever of two factors it is shown by."""
        level = self.level
        names = {f"{level.factor}={level.name}", level.at}
        return frozenset(names), level.mark, self.metric.name

    @property
    def groups(self) -> tuple[str, ...]:
        """The ids of all groups whose trials it rests on."""
        every = (self.level, self.reference, *(self.across or ()))
        return tuple(dict.fromkeys(name for level in every for name in level.groups))


@remembered
def effects(study: Study, by: str = "") -> list[Effect]:
    """The effects of every factor, and the interactions of any two of them.

    With ``by``, those of the others at each level of this one, and the interactions with it.
    Their p are corrected by Holm in two families: of the study's primary measure the main effects
    of factors other than ``model``, and all others together. Raises UsageError for an unknown
    factor.
    """
    if not by:
        main = [one for levels in levels_by_factor(study) for one in _of_levels(study, levels)]
        return _with_corrected(study, [*main, *_interactions(study)])
    if by == DRIVER:
        shown = list(dict.fromkeys(group.driver for group in study.models))
    else:
        shown = require(levels_of(study.models, study.order), "factor", by)
    simple = [
        one
        for at in shown
        for levels in levels_by_factor(study, by, at)
        for one in _of_levels(study, levels)
    ]
    crossed = [] if by == DRIVER else [*_interactions(study, by)]
    p_corrected = {one.key: one.p_corrected for one in effects(study)} if crossed else {}
    return [
        *_with_corrected(study, simple),
        *(replace(one, p_corrected=p_corrected.get(one.key)) for one in crossed),
    ]


def driver_effects(study: Study, one: Group, other: Group) -> list[Effect]:
    """One driver with its prompt less another, in every measure, in the conditions of both.

    Their p are corrected together by Holm.
    """
    levels = []
    for group in (other, one):
        cells = pd.Series([(each,) for each in group.trials["condition"]], group.trials.index)
        pooled = replace(group, trials=group.trials.assign(cell=cells), whole=None)
        levels.append(Level(DRIVER, group.id, (group.id,), pooled))
    return _with_corrected(study, [*_of_levels(study, levels)])


@remembered
def primary(study: Study) -> Metric:
    """The measure that the study names as its primary one, else who goes first.

    Without a chosen study it is the one whose parts are in use, as in the explorer.

    Raises UsageError where there is no such measure.
    """
    in_use_here = StudySource(name="", text=text, plugins={}) if (text := in_use().text) else None
    source = study.source or in_use_here
    named = source.file.primary if source else PRIMARY
    known = {PRIMARY: LEFT_FIRST, "collided": COLLISIONS, **METRICS}
    require(known, "measure", named, "as the study's primary one")
    return known[named]


@remembered
def measured(study: Study) -> list[Metric]:
    """The metrics of which some trial has a value, the primary one first.

    Where the rule that was played is the humans' own, collisions by that are no second measure.
    """
    trials = [group.trials for group in study.models]
    same = all(rows[COLLISIONS.column].equals(rows[BOXES.column]) for rows in trials)
    return [
        metric
        for metric in sorted(METRICS.values(), key=lambda one: one is not primary(study))
        if any(rows[metric.column].notna().any() for rows in trials)
        and not (same and metric is BOXES)
    ]


def _of_levels(study: Study, levels: Sequence[Level]) -> Iterator[Effect]:
    """Each level but the first against that one, measure by measure."""
    reference, *others = levels
    for metric, level in product(measured(study), others):
        yield _effect(study, metric, (level, reference))


def _interactions(study: Study, by: str = "") -> Iterator[Effect]:
    """How far effects differ between the levels of another factor, or of this one, and its first.

    The two differences are those of the factor that stands first, so that both ways round the
    interaction is one number.
    """
    factors = levels_of(study.models, study.order)
    varying = [name for name, levels in factors.items() if len(levels) > 1]
    varying.sort(key=lambda name: name == MODEL)
    tested = [metric for metric in measured(study) if metric.estimator != "median"]
    pairs = [(name, by) for name in varying if name != by] if by else combinations(varying, 2)
    for factor, other in pairs:
        turned = varying.index(other) < varying.index(factor) if other in varying else False
        first, *others = ([*_at(study, factor, other, at)] for at in factors[other])
        for (base, *twins), (reference, *levels) in product(first, chain(*others)):
            if (base.name, base.mark) != (reference.name, reference.mark):
                continue
            same = {twin.name: twin for twin in twins}
            for metric, level in product(tested, levels):
                if level.name in same:
                    four = (level, reference, same[level.name], base)
                    yield _effect(study, metric, four, turned=turned)


def _at(study: Study, factor: str, by: str, at: str) -> Iterator[list[Level]]:
    """The levels of a factor at one of another, those of stand-ins apart."""
    for levels in levels_by_factor(study, by, at):
        if levels[0].factor == factor:
            yield levels


def _effect(
    study: Study, metric: Metric, levels: Sequence[Level], *, turned: bool = False
) -> Effect:
    """One level less another; of four, less that of the others."""
    frames = trials_by_cell(study, [level.pooled for level in levels], metric)
    left_out = {copy for level in levels for copy in level.copies}
    for level, frame in zip(levels, frames, strict=False):
        trials = level.pooled.trials
        unused = ~trials.index.isin(frame.index)
        if unused.any():
            left_out |= {*zip(*(trials[name].array[unused] for name in KEYS), strict=True)}
    ordered = [frames[place] for place in (0, 2, 1, 3)] if turned and frames else frames
    found = _difference(ordered, metric) or Estimate()
    # Where nothing varies it is not known what could have been seen.
    found = replace(found, detectable=found.detectable or None)
    both = _of_both(frames[0], frames[1], metric) if frames else (Estimate(), Estimate())
    if len(levels) > 2:
        both = (replace(both[0], value=None), replace(both[1], value=None))
    return Effect(
        *(levels[0], levels[1], metric, *both),
        difference=found.times(100 if metric.rate else 1),
        left_out=tuple(sorted(left_out)),
        across=(levels[2], levels[3]) if len(levels) > 2 else None,
    )


def _of_both(
    first: pd.DataFrame, second: pd.DataFrame, metric: Metric
) -> tuple[Estimate, Estimate]:
    """What both groups of trials come to, one less the other of which is their difference."""
    one, other = (_counted(frame, metric) for frame in (first, second))
    if not one.n:
        return one, other
    if metric.estimator == "median":
        values = float(first["value"].median()), float(second["value"].median())
    elif metric.rate and (cells := shared_cells(first, second, "value")):
        values = 100 * cells.rates[0], 100 * cells.rates[1]
    else:
        values = means_within(first, second, "value")
    return replace(one, value=values[0]), replace(other, value=values[1])


def _counted(frame: pd.DataFrame, metric: Metric) -> Estimate:
    """How many trials there are, and in how many it is so; not of those read from both sides."""
    from_both = "varies" in frame and not frame["varies"].all()
    k = int(frame["value"].sum()) if metric.rate and not from_both else None
    return Estimate(n=frame.index.nunique(), k=k)


def _difference(frames: Sequence[pd.DataFrame], metric: Metric) -> Estimate | None:
    """That of two groups of trials, or of two such differences; None where nothing is tested."""
    if not frames or frames[0].empty:
        return None
    pairs = list(zip(frames[::2], frames[1::2], strict=True))
    if metric.estimator == "median":
        return Estimate(float(frames[0]["value"].median() - frames[1]["value"].median()))
    if metric.rate:
        cells = [rates for pair in pairs if (rates := shared_cells(*pair, "value"))]
        return difference_of_contrasts(*cells) if len(cells) > 1 else contrast_rates(*cells)
    means = [mean for pair in pairs if (mean := contrast_means(*pair, "value"))]
    if len(means) < len(pairs):
        return None
    return difference(*means) if len(means) > 1 else means[0]


def _with_corrected(study: Study, found: list[Effect]) -> list[Effect]:
    """The effects with their corrected p, in the study's own family or in that of all others.

    Where nothing varies and nothing differs, as without a single collision, p is no part of it.
    """
    asked = [_is_asked(study, one) for one in found]
    p_of = {place: one.difference.p for place, one in enumerate(found)}
    for own in (True, False):
        family = {
            place: one.difference.p
            for place, one in enumerate(found)
            if asked[place] is own and one.difference.p is not None and _can_differ(one)
        }
        p_of |= dict(zip(family, corrected([*family.values()]), strict=True))
    return [
        replace(one, primary=asked[place], p_corrected=p_of[place])
        for place, one in enumerate(found)
    ]


def _is_asked(study: Study, one: Effect) -> bool:
    """Whether it is a main effect on the study's primary measure."""
    is_main = not one.across and one.level.factor not in (MODEL, DRIVER)
    return is_main and one.metric is primary(study)


def _can_differ(one: Effect) -> bool:
    return bool(one.difference.se or one.difference.value)


def trials_by_cell(study: Study, groups: Sequence[Group], metric: Metric) -> list[pd.DataFrame]:
    """The ``value`` of each group's trials with their cell as ``condition``, in cells of all.

    Cells of programs that do not heed what the groups differ in are left out. Nothing where the
    groups are of several studies or have undecided trials.
    """
    if not in_one_study(study, *groups) or any(undecided(group, metric) for group in groups):
        return []
    copied, frames = copied_cells(study, tuple(groups)), []
    for group in groups:
        trials = group.trials
        counted = trials[metric.column].notna().to_numpy()
        if copied:
            counted = counted & ~trials["cell"].isin(copied).to_numpy()
        columns = {"condition": "cell", "value": metric.column, "weight": metric.weight_column}
        named = {name: trials[own] for name, own in columns.items() if own in trials}
        frame = pd.DataFrame(named)[counted]
        if metric.weight:
            frame["value"] = linear(frame["value"], frame["weight"], frame["condition"])
        elif metric is LEFT_FIRST and one_sided(study):
            frame = _from_both_sides(study, frame, trials)
        frames.append(frame)
    kept = set.intersection(*(set(one["condition"]) for one in frames))
    return [frame[frame["condition"].isin(kept)] for frame in frames]


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


def _from_both_sides(study: Study, frame: pd.DataFrame, trials: pd.DataFrame) -> pd.DataFrame:
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


@remembered
def copied_cells(study: Study, groups: tuple[Group, ...]) -> set[Cell]:
    """The cells of programs that do not heed what the groups differ in.

    With the same other levels, all trials of one of two groups are copies of the other's there, in
    every condition that both have. What they differ by is how often each was drawn, so that nothing
    can be tested. Conditions are never left out one by one: which of them stay would depend on
    what happened there.
    """
    ways = [_ways(study, group) for group in groups]
    copied: set[Cell] = set()
    for one, other in combinations(ways, 2):
        for others in one.keys() & other.keys():
            if _are_copies(one[others], other[others]):
                copied |= {(name, *others) for name in one[others].keys() & other[others].keys()}
    return copied


@remembered
def _ways(study: Study, group: Group) -> dict[Cell, dict[str, set[object]]]:
    """The ways in which trials went, by the levels of the other factors and by condition."""
    ways: dict[Cell, dict[str, set[object]]] = {}
    for (condition, *others), way in zip(group.ended["cell"], group.ended["way"], strict=True):
        ways.setdefault((*others,), {}).setdefault(condition, set()).add(way)
    return ways


def _are_copies(one: Mapping[str, set[object]], other: Mapping[str, set[object]]) -> bool:
    """Whether in every condition that both have all trials of one are among the other's."""
    shared = one.keys() & other.keys()
    return bool(shared) and all(
        one[name] <= other[name] or other[name] <= one[name] for name in shared
    )


def copied_of_shared(study: Study, *levels: Level) -> tuple[int, int]:
    """How many of the cells that levels share are copied ones, and how many they share."""
    shared = set.intersection(*({*level.pooled.ended["cell"]} for level in levels))
    return len(shared & copied_cells(study, tuple(level.pooled for level in levels))), len(shared)


@remembered
def levels_by_factor(study: Study, by: str = "", at: str = "", least: int = 2) -> list[list[Level]]:
    """The levels of each factor that has so many of them at ``least``, the reference first.

    Trials of scripted stand-ins are never pooled with others. With ``by``, the trials are those
    ``at`` one of its levels.
    """
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
    said = {group.posing for group in groups}
    posing = said.pop() if len(said) == 1 else "scripted stand-ins"
    mark = " [scripted]" if apart and posing else ""
    at = f"{by}={_level_of(groups[0], by)}" if by else ""
    pooled = _with_cells(groups, {factor, by})
    return Level(factor, name, tuple(group.id for group in groups), pooled, posing, mark, at)


def _with_cells(groups: Sequence[Group], apart_from: set[str]) -> Group:
    """Groups as one, whose trials have their cell: condition and levels of the other factors."""
    parts = []
    for group in groups:
        others = [f"{n}={level}" for n, level in group.levels.items() if n not in apart_from]
        others += [group.mark.strip()] * bool(group.mark)  # another setting of the task
        cells = [(condition, *others) for condition in group.trials["condition"]]
        cells_of = pd.Series(cells, group.trials.index, dtype=object)
        parts.append(group.trials.assign(cell=cells_of, group=group.id))
    return replace(groups[0], trials=pd.concat(parts, ignore_index=True))


def crossing(study: Study, factors: Sequence[str], wanted: Mapping[str, str]) -> list[Level]:
    """The trials at these levels of several factors, as a level of their crossing.

    Those of scripted stand-ins are another one.
    """
    chosen = [g for g in study.models if all(_level_of(g, f) == at for f, at in wanted.items())]
    found = []
    for scripted in (False, True):
        groups = [group for group in chosen if group.scripted == scripted]
        if not groups:
            continue
        mark = " [scripted]" if scripted and len(groups) < len(chosen) else ""
        name = ", ".join(wanted[factor] for factor in factors)
        pooled = _with_cells(groups, {*wanted})
        ids = tuple(group.id for group in groups)
        found += _distinct(study, [Level(TIMES.join(factors), name, ids, pooled, mark=mark)])
    return found


def _distinct(study: Study, levels: list[Level]) -> list[Level]:
    """The levels, each without copies of trials, and with the cells that share these as one."""
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


def _with_copies(study: Study, group: Group) -> Iterator[Iterable[Cell]]:
    """Cells that have copies of each other's trials.

    Of programs those of a condition in which any trials are equal. A stand-in plays with chance:
    its trials of two levels that it reads may be equal here and there, which makes them no copies.
    """
    if not group.scripted:
        yield from (cells for _, cells in group.trials.groupby(["condition", "way"])["cell"])
        return
    for (own, one), (its, other) in combinations(_ways(study, group).items(), 2):
        if _are_copies(one, other):
            yield from (((name, *own), (name, *its)) for name in one.keys() & other.keys())


def _without_copies(level: Level, first: Callable[[tuple[str, ...]], tuple[str, ...]]) -> Level:
    every = level.pooled.trials
    every = every.assign(cell=pd.Series([first(cell) for cell in every["cell"]], dtype=object))
    kept = every.drop_duplicates(["cell", "way"])
    pooled = replace(level.pooled, trials=kept, whole=replace(level.pooled, trials=every))
    return replace(level, groups=tuple(kept["group"].unique()), pooled=pooled)
