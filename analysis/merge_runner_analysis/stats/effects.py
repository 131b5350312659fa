"""Effects of factors: each level against the reference, in every measure.

Levels are compared within the cells that both have: a condition with one level of each other
factor. A driver is a level of the factor ``model``; an interaction is a difference of differences,
in the cells that all four have.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import chain, combinations, product

import pandas as pd

from merge_runner.errors import UsageError
from merge_runner.registry import in_use, require
from merge_runner.study.arms import MODEL
from merge_runner.study.file import StudyFile, StudySource, StudyText
from merge_runner.text_safety import first_line
from merge_runner_analysis.cache import remembered
from merge_runner_analysis.frames import KEYS
from merge_runner_analysis.grouping import Group, levels_of
from merge_runner_analysis.metrics import BOXES, COLLISIONS, LEFT_FIRST, METRICS, Metric
from merge_runner_analysis.stats import contrasts
from merge_runner_analysis.stats.estimate import Estimate
from merge_runner_analysis.stats.intervals import difference
from merge_runner_analysis.stats.levels import DRIVER, Level, copied_cells, levels_by_factor
from merge_runner_analysis.stats.measures import linear, undecided
from merge_runner_analysis.stats.sides import from_both_sides, one_sided
from merge_runner_analysis.study import Study, in_one_study
from merge_runner_analysis.wording import TIMES, UNREADABLE

PRIMARY = "goes_first"  # in a study's file, and where none is named


@dataclass(frozen=True, eq=False)
class Effect:
    """A level against the reference of its factor, in one measure, in the unit of that.

    ``at_level`` and ``at_reference`` are the estimates within the shared cells, in which the trials
    count without ``left_out``; their ``difference`` has its interval, p and detectable. Values are
    None where nothing is compared. The first two of an interaction have no value but their trials;
    its ``across`` are the same two levels at the reference of the other factor.
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
        """Identity of the comparison, whichever of two factors it is shown by."""
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
def effects(study: Study, by: str = "") -> list[Effect]:
    """Return the effects of every factor, and the interactions of any two of them.

    With ``by``, those of the others at each level of this one, and the interactions with it.
    Their p are corrected by Holm in two families: of the study's primary measure the main effects
    of factors other than ``model``, and all others together. Raises UsageError for an unknown
    factor.
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


def driver_effects(study: Study, driver: Group, reference: Group) -> list[Effect]:
    """Compare two drivers with their prompts in every measure, in the conditions of both.

    Their p are corrected by Holm; that of the primary measure is no part of that where the study
    ``asks_of_models``.
    """
    levels = []
    for group in (reference, driver):
        cells = pd.Series([(name,) for name in group.trials["condition"]], group.trials.index)
        pooled = replace(group, trials=group.trials.assign(cell=cells), whole=None)
        levels.append(Level(DRIVER, group.id, (group.id,), pooled))
    return _with_corrected(study, [*_of_levels(study, levels)])


@remembered
def primary(study: Study) -> Metric:
    """Return the measure that the study names as its primary one, else who goes first.

    Raises UsageError where there is no such measure.
    """
    return _measures()[_named(study) or PRIMARY]


@remembered
def asks_of_models(study: Study) -> bool:
    """Return whether a study names a primary measure, and varies nothing but the model."""
    factors = levels_of(study.models, study.order)
    varying = {name for name, levels in factors.items() if len(levels) > 1}
    return varying == {MODEL} and bool(_named(study))


def _measures() -> dict[str, Metric]:
    return {PRIMARY: LEFT_FIRST, "collided": COLLISIONS, **METRICS}


def _named(study: Study) -> str:
    """Return the primary measure that stands in the study's file: empty without one.

    The file is that of the chosen study, else the one whose parts are in use, else the only one
    that was played, whose own measures are missing where its plug-ins are not in use.
    """
    file, _ = _file(study)
    if file is None or "primary" not in file.model_fields_set:
        return ""
    if file.primary not in _measures() and not _text_at_hand(study):
        return ""
    require(_measures(), "measure", file.primary, "as the study's primary one")
    return file.primary


def texts_of(study: Study) -> dict[str, dict[str, StudyText]]:
    """Return the texts of a study's factors by level; empty where its file is not known."""
    file, _ = _file(study)
    return {} if file is None else dict(file.texts)


def unreadable(study: Study) -> str:
    """Say that the stored study that was played cannot be read, and why; empty where it can."""
    return _file(study)[1]


def _text_at_hand(study: Study) -> str:
    return study.source.text if study.source else in_use().text


@remembered
def _file(study: Study) -> tuple[StudyFile | None, str]:
    """Return the study's file, if there is one, or why the stored one cannot be read.

    A text at hand is the user's to mend: raises UsageError.
    """
    if text := _text_at_hand(study):
        return StudySource(name="", text=text, plugins={}).file, ""
    played = study.frames.studies
    text = played.texts.get(next(iter(played.orders)), "") if len(played.orders) == 1 else ""
    try:
        return StudySource(name="", text=text, plugins={}).file if text else None, ""
    except UsageError as exc:
        return None, f"{UNREADABLE}, which takes who goes first as its measure: {first_line(exc)}"


@remembered
def measured(study: Study) -> list[Metric]:
    """Return the metrics of which some trial has a value, the primary one first.

    Where the rule that was played is the humans' own, collisions by that are no second measure.
    """
    trials = [group.trials for group in study.models]
    same = all(rows[COLLISIONS.column].equals(rows[BOXES.column]) for rows in trials)
    return [
        metric
        for metric in sorted(METRICS.values(), key=lambda measure: measure is not primary(study))
        if any(rows[metric.column].notna().any() for rows in trials)
        and not (same and metric is BOXES)
    ]


def _of_levels(study: Study, levels: Sequence[Level]) -> Iterator[Effect]:
    reference, *others = levels
    for metric, level in product(measured(study), others):
        yield _effect(study, metric, (level, reference))


def _interactions(study: Study, by: str = "") -> Iterator[Effect]:
    """Compare effects between the levels of another factor, or of this one, and its first.

    The two differences are those of the factor that stands first, so that the interaction is one
    number in either order.
    """
    factors = levels_of(study.models, study.order)
    varying = [name for name, levels in factors.items() if len(levels) > 1]
    varying.sort(key=lambda name: name == MODEL)
    tested = [metric for metric in measured(study) if metric.estimator != "median"]
    pairs = [(name, by) for name in varying if name != by] if by else combinations(varying, 2)
    for factor, other in pairs:
        swapped = other in varying and varying.index(other) < varying.index(factor)
        # Those of mock models are apart.
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
    study: Study, metric: Metric, levels: Sequence[Level], *, swapped: bool = False
) -> Effect:
    """Compare two levels; of four, the difference of the first two with that of the others."""
    frames = trials_by_cell(study, [level.pooled for level in levels], metric)
    left_out = {copy for level in levels for copy in level.copies}
    for level, frame in zip(levels, frames, strict=False):
        unused = level.pooled.trials[KEYS].drop(index=frame.index.unique())
        left_out.update(unused.itertuples(index=False, name=None))
    values: tuple[float | None, float | None] = (None, None)
    difference = None
    if frames and len(frames[0]):
        if len(frames) == 2:
            values, difference = _compared(frames[0], frames[1], metric)
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
        at_reference=replace(counts[1], value=values[1]),
        # Where nothing varies it is not known what could have been seen.
        difference=replace(difference, detectable=difference.detectable or None),
        left_out=tuple(sorted(left_out)),
        across=(levels[2], levels[3]) if len(levels) > 2 else None,
    )


def _counted(frame: pd.DataFrame, metric: Metric) -> Estimate:
    """Count the trials, and those in which it is so; not of those read from both sides."""
    from_both = "varies" in frame and not frame["varies"].all()
    k = int(frame["value"].sum()) if metric.rate and not from_both else None
    return Estimate(n=frame.index.nunique(), k=k)


def _compared(
    level: pd.DataFrame, reference: pd.DataFrame, metric: Metric
) -> tuple[tuple[float, float], Estimate | None]:
    """Return both values and their difference, None where that is not known."""
    if metric.estimator == "median":
        medians = float(level["value"].median()), float(reference["value"].median())
        return medians, Estimate(medians[0] - medians[1])
    if metric.rate and (cells := contrasts.shared_cells(level, reference, "value")):
        first, second = cells.rates
        return (100 * first, 100 * second), contrasts.contrast_rates(cells).times(100)
    means = contrasts.means_within(level, reference, "value")
    return means, contrasts.contrast_means(level, reference, "value")


def _interaction(frames: Sequence[pd.DataFrame], metric: Metric) -> Estimate | None:
    """Return the difference of the first two less that of the others; None if one is not known."""
    level, reference, twin, base = frames
    if metric.rate:
        cells = contrasts.shared_cells(level, reference, "value")
        others = contrasts.shared_cells(twin, base, "value")
        if cells is None or others is None:
            return None
        return contrasts.difference_of_contrasts(cells, others).times(100)
    mean = contrasts.contrast_means(level, reference, "value")
    other = contrasts.contrast_means(twin, base, "value")
    return difference(mean, other) if mean and other else None


def _with_corrected(study: Study, effects: list[Effect]) -> list[Effect]:
    """Return the effects with their corrected p, in the study's own family or that of all others.

    Where nothing varies and nothing differs, as without a single collision, p is no part of it.
    """
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
            if is_primary[place] is of_primary
            and effect.difference.p is not None
            and (effect.difference.se or effect.difference.value)
        }
        p |= dict(zip(family, contrasts.corrected([*family.values()]), strict=True))
    return [
        replace(effect, primary=is_primary[place], p_corrected=p[place])
        for place, effect in enumerate(effects)
    ]


def trials_by_cell(study: Study, groups: Sequence[Group], metric: Metric) -> list[pd.DataFrame]:
    """Return the ``value`` of each group's trials and their cell as ``condition``, in cells of all.

    Cells of programs that ignore the groups' difference are left out. Nothing where the
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
        frame = pd.DataFrame(
            {name: trials[column] for name, column in columns.items() if column in trials}
        )[counted]
        if metric.weight:
            frame["value"] = linear(frame["value"], frame["weight"], frame["condition"])
        elif metric is LEFT_FIRST and one_sided(study):
            frame = from_both_sides(study, frame, trials)
        frames.append(frame)
    shared = set.intersection(*(set(frame["condition"]) for frame in frames))
    return [frame[frame["condition"].isin(shared)] for frame in frames]
