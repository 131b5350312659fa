"""Effects of factors: each level against the reference in every measure, within shared cells."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import chain, combinations, compress, product
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from merge_runner.registry import require
from merge_runner.study.arms import MODEL
from merge_runner_analysis.cache import remembered
from merge_runner_analysis.grouping import Group, levels_of
from merge_runner_analysis.metrics import BOXES, COLLISIONS, LEFT_FIRST, METRICS, Metric
from merge_runner_analysis.stats import contrasts
from merge_runner_analysis.stats.estimate import Estimate
from merge_runner_analysis.stats.intervals import difference
from merge_runner_analysis.stats.levels import DRIVER, Cell, Level, copied_cells, levels_by_factor
from merge_runner_analysis.stats.measures import linear, undecided
from merge_runner_analysis.stats.sides import from_both_sides, one_sided
from merge_runner_analysis.stats.study_file import asks_of_models, primary
from merge_runner_analysis.study import StudyResults, in_one_study
from merge_runner_analysis.wording import TIMES

Columns = dict[str, NDArray[Any]]  # of trials
Comparison = tuple[tuple[float, float], Estimate | None]  # both values and their difference


@dataclass(frozen=True, eq=False)
class Effect:
    """A level against the reference of its factor in one measure, in the measure's unit.

    ``at_level`` and ``at_reference`` are estimates within the shared cells, without the
    ``left_out`` trials. In an interaction they have no value, ``across`` has both levels at the
    other factor's reference, and ``at_reference`` counts the trials at both references.
    ``p_corrected`` is Holm's: primary effects are one family, all others another.
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
    def varies(self) -> bool:
        """Return whether trials of a cell differ, or levels do: else no p could be below 1."""
        return bool(self.difference.se or self.difference.value)

    @property
    def key(self) -> tuple[frozenset[str], str, str]:
        """Identity of the comparison, the same for both orders of an interaction's factors."""
        level = self.level
        names = {f"{level.factor}={level.name}", level.at}
        return frozenset(names), level.mark, self.metric.name

    @property
    def levels(self) -> tuple[Level, ...]:
        """The two levels, or the four of an interaction."""
        return (self.level, self.reference, *(self.across or ()))

    @property
    def groups(self) -> tuple[str, ...]:
        """The ids of all groups whose trials it rests on."""
        return tuple(dict.fromkeys(name for level in self.levels for name in level.groups))


@remembered
def effects(study: StudyResults, by: str = "") -> list[Effect]:
    """Return the effects of every factor and their interactions, or those at each level of ``by``.

    Holm corrects p in two families: main effects on the primary measure (of ``model`` only if
    ``asks_of_models``), and all others. Raises UsageError for an unknown factor.
    """
    if not by:
        main = [
            effect for levels in levels_by_factor(study) for effect in _of_levels(study, levels)
        ]
        return _with_corrected(study, [*main, *_interactions(study)])
    if by == DRIVER:
        names = list(dict.fromkeys(group.driver for group in study.models))
        interactions = []
    else:
        names = require(levels_of(study.models, study.order), "factor", by)
        p_corrected = {effect.key: effect.p_corrected for effect in effects(study)}
        interactions = [
            replace(effect, p_corrected=p_corrected.get(effect.key))
            for effect in _interactions(study, by)
        ]
    by_factor = chain.from_iterable(levels_by_factor(study, by, name) for name in names)
    simple = [effect for levels in by_factor for effect in _of_levels(study, levels)]
    return [*_with_corrected(study, simple), *interactions]


def driver_effects(study: StudyResults, driver: Group, reference: Group) -> list[Effect]:
    """Compare two drivers with their prompts in every measure, in the conditions of both."""
    levels = []
    for group in (reference, driver):
        cells = pd.Series([(name,) for name in group.trials["condition"]], group.trials.index)
        pooled = replace(group, trials=group.trials.assign(cell=cells), whole=None)
        levels.append(Level(DRIVER, group.id, (group.id,), pooled))
    return _with_corrected(study, [*_of_levels(study, levels)])


@remembered
def measured(study: StudyResults) -> list[Metric]:
    """Return the metrics that some trial has, the primary one first."""
    trials = [group.trials for group in study.models]
    same = all(rows[COLLISIONS.column].equals(rows[BOXES.column]) for rows in trials)
    return [
        metric
        for metric in sorted(METRICS.values(), key=lambda measure: measure is not primary(study))
        if any(rows[metric.column].notna().any() for rows in trials)
        and not (same and metric is BOXES)
    ]


def _of_levels(study: StudyResults, levels: Sequence[Level]) -> Iterator[Effect]:
    reference, *others = levels
    for metric, level in product(measured(study), others):
        yield _effect(study, metric, (level, reference))


def _interactions(study: StudyResults, by: str = "") -> Iterator[Effect]:
    """Yield effects at each level of another factor, or of ``by``, less those at its first level.

    Both differences are effects of the factor that is listed first, so that both orders give the
    same number.
    """
    factors = levels_of(study.models, study.order)
    varying = [name for name, levels in factors.items() if len(levels) > 1]
    varying.sort(key=lambda name: name == MODEL)
    tested = [metric for metric in measured(study) if metric.estimator != "median"]
    pairs = [(name, by) for name in varying if name != by] if by else combinations(varying, 2)
    for factor, other in pairs:
        swapped = other in varying and varying.index(other) < varying.index(factor)
        # The lists of levels of mock models are apart.
        first, *others = (
            [levels for levels in levels_by_factor(study, other, at) if levels[0].factor == factor]
            for at in factors[other]
        )
        for (base, *twins), (reference, *levels) in product(first, chain(*others)):
            if (base.name, base.mark) != (reference.name, reference.mark):
                continue
            twin_of = {twin.name: twin for twin in twins}
            for metric, level in product(tested, levels):
                if twin := twin_of.get(level.name):
                    yield _effect(study, metric, (level, reference, twin, base), swapped=swapped)


def _effect(
    study: StudyResults, metric: Metric, levels: Sequence[Level], *, swapped: bool = False
) -> Effect:
    """Compare two levels; with four, compare the differences of the first and the last two."""
    frames = trials_by_cell(study, tuple(level.pooled for level in levels), metric)
    left_out = {copy for level in levels for copy in level.copies}
    for level, frame in zip(levels, frames, strict=False):
        unused = np.ones(len(level.keys), bool)
        unused[frame["row"]] = False
        left_out.update(compress(level.keys, unused))
    values: tuple[float | None, float | None] = (None, None)
    difference = None
    if frames and len(frames[0]["row"]):
        if len(frames) == 2:
            values, difference = _compared(study, frames[0], frames[1], metric)
        else:
            ordered = [frames[place] for place in ((0, 2, 1, 3) if swapped else range(4))]
            difference = _interaction(ordered, metric)
    counts = [_counted(frame, metric) for frame in frames] or [Estimate(), Estimate()]
    difference = difference or Estimate()
    return Effect(
        level=levels[0],
        reference=levels[1],
        metric=metric,
        at_level=replace(counts[0], value=values[0]),
        at_reference=replace(counts[-1], value=values[1]),
        # Where nothing varies it is not known what could have been seen.
        difference=replace(difference, detectable=difference.detectable or None),
        left_out=tuple(sorted(left_out)),
        across=(levels[2], levels[3]) if len(levels) > 2 else None,
    )


def _counted(frame: Columns, metric: Metric) -> Estimate:
    """Count trials, and the hits of a rate, unless trials count for both sides."""
    from_both = not contrasts.read_once(frame["row"]).all()
    k = int(frame["value"].sum()) if metric.rate and not from_both else None
    return Estimate(n=len(np.unique(frame["row"])), k=k)


def _compared(
    study: StudyResults, level: Columns, reference: Columns, metric: Metric
) -> Comparison:
    """Return both values and their difference; None if the difference is not known.

    Several views show the same comparison, which is made once.
    """
    key = (
        metric.name,
        *(
            column.tobytes()
            for of in (level, reference)
            for column in (of["condition"], of["value"], contrasts.read_once(of["row"]))
        ),
    )
    known = _comparisons(study)
    if key not in known:
        known[key] = _compare(level, reference, metric)
    return known[key]


@remembered
def _comparisons(_: StudyResults) -> dict[tuple[object, ...], Comparison]:
    return {}


def _compare(level: Columns, reference: Columns, metric: Metric) -> Comparison:
    if metric.estimator == "median":
        medians = float(np.median(level["value"])), float(np.median(reference["value"]))
        return medians, Estimate(medians[0] - medians[1])
    if metric.rate and (cells := contrasts.shared_cells(level, reference, "value")):
        first, second = cells.rates
        return (100 * first, 100 * second), contrasts.contrast_rates(cells).in_percent()
    means = contrasts.means_within(level, reference, "value")
    return means, contrasts.contrast_means(level, reference, "value")


def _interaction(frames: Sequence[Columns], metric: Metric) -> Estimate | None:
    """Return the difference of the first two less that of the others; None if unknown."""
    level, reference, twin, base = frames
    if metric.rate:
        cells = contrasts.shared_cells(level, reference, "value")
        others = contrasts.shared_cells(twin, base, "value")
        if cells is None or others is None:
            return None
        return contrasts.difference_of_contrasts(cells, others).in_percent()
    mean = contrasts.contrast_means(level, reference, "value")
    other = contrasts.contrast_means(twin, base, "value")
    return difference(mean, other) if mean and other else None


def _with_corrected(study: StudyResults, effects: list[Effect]) -> list[Effect]:
    """Correct p within both families; an effect in which nothing varies is in neither."""
    of_model = {MODEL, DRIVER} if asks_of_models(study) else set()
    is_primary = [
        effect.metric is primary(study)
        and not effect.across
        and (effect.level.factor in of_model or effect.level.factor not in (MODEL, DRIVER))
        for effect in effects
    ]
    p = {place: effect.difference.p for place, effect in enumerate(effects)}
    for of_primary in (True, False):
        family = {
            place: effect.difference.p
            for place, effect in enumerate(effects)
            if is_primary[place] is of_primary and effect.difference.p is not None and effect.varies
        }
        p |= dict(zip(family, contrasts.corrected([*family.values()]), strict=True))
    return [
        replace(effect, primary=is_primary[place], p_corrected=p[place])
        for place, effect in enumerate(effects)
    ]


def trials_by_cell(study: StudyResults, groups: tuple[Group, ...], metric: Metric) -> list[Columns]:
    """Return, by group, ``condition``, ``value`` and ``row`` of trials in cells that all share.

    Copied cells are left out. Empty for groups of several studies or with undecided trials.
    """
    if not in_one_study(study, *groups) or any(undecided(group, metric) for group in groups):
        return []
    is_read_twice, parts = metric is LEFT_FIRST and one_sided(study), []
    for group, (row, code) in zip(groups, _codes(study, groups), strict=True):
        values = group.trials[metric.column].to_numpy(float, na_value=np.nan)[row]
        known = ~np.isnan(values)
        part = {"condition": code[known], "value": values[known], "row": row[known]}
        if metric.weight:
            weight = group.trials[metric.weight_column].to_numpy(float)[part["row"]]
            part["value"] = linear(part["value"], weight, part["condition"])
        if is_read_twice:
            trials = group.trials.iloc[part["row"]]
            frame = pd.DataFrame(part, trials.index).assign(condition=trials["cell"])
            both = from_both_sides(study, frame, trials)
            part = {name: both[name].to_numpy() for name in both}
        parts.append(part)
    # Codes in the order of the trials, so that equal trials have equal ones.
    cells, names = pd.factorize(np.concatenate([part["condition"] for part in parts]))
    of_parts = np.split(cells, np.cumsum([len(part["row"]) for part in parts])[:-1])
    shared = np.min([np.bincount(codes, minlength=len(names)) for codes in of_parts], axis=0) > 0
    samples = []
    for part, codes in zip(parts, of_parts, strict=True):
        columns = part | {"condition": np.cumsum(shared)[codes] - 1}
        samples.append({name: column[shared[codes]] for name, column in columns.items()})
    return samples


@remembered
def _codes(
    study: StudyResults, groups: tuple[Group, ...]
) -> list[tuple[NDArray[np.int_], NDArray[np.int_]]]:
    """Return, by group, the rows of trials outside copied cells, and codes of their cells."""
    copied = copied_cells(study, groups)
    numbers: dict[Cell, int] = {}
    parts = []
    for group in groups:
        rows = [(row, cell) for row, cell in enumerate(group.trials["cell"]) if cell not in copied]
        codes = [numbers.setdefault(cell, len(numbers)) for _, cell in rows]
        parts.append((np.array([row for row, _ in rows], int), np.array(codes, int)))
    return parts
