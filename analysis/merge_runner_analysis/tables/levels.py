"""Results at each level of each factor, and in crossings; the first page draws this table."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import product

import pandas as pd

from merge_runner.records import SIDES
from merge_runner.study.arms import MODEL, OPPONENT
from merge_runner_analysis.metrics import COLLISIONS, GAP, RMSE, Metric
from merge_runner_analysis.stats.levels import Level, crossing, levels_by_factor
from merge_runner_analysis.stats.measures import counts, estimate
from merge_runner_analysis.stats.sides import have_same_prompts, level_estimate, one_sided
from merge_runner_analysis.stats.study_file import primary, texts_of
from merge_runner_analysis.study import StudyResults
from merge_runner_analysis.tables.model import ENDED, Column, Optional, Row, Table, Value, interval
from merge_runner_analysis.wording import EGO, HALVES, LEFT, TIMES

# More crossings than these are no chart.
MOST_CROSSINGS = 8


def levels(study: StudyResults) -> Table:
    """Return a row per level and per crossing of factors, of all drivers and of each."""
    metric = primary(study)
    hits = metric.column if metric.rate else ""
    return Table(
        "levels",
        (
            Column("factor", "factor"),
            Column("level", "level"),
            Optional("driver", "driver"),
            Optional("k", metric.label, "count", "trials in which it is so", hits),
            Column("n", "n", "count", f"trials that count: {metric.meaning}"),
            Optional("value", metric.heading, "number", metric.meaning),
            interval("ci", f"of {metric.heading}"),
            Optional("repeated", "repeated", "count", "trials that repeat another one, left out"),
            Column("crashed", "crashed", "count", COLLISIONS.meaning, COLLISIONS.column,
                   rests_on=COLLISIONS.column),
            Column("ended", "of", "count", "trials that ended", rests_on=ENDED),
            Optional("gap_m", GAP.heading, "number", GAP.meaning, rests_on=GAP.column),
            Optional("rmse_mps", RMSE.heading, "number", RMSE.meaning, rests_on=RMSE.column),
        ),
        [_row(study, level, driver, metric) for driver, level in _every(study)],
        (
            "all trials of a level, whether or not another level has the same cells: differences "
            "are in the table effects. A crossing leaves out the driver and the opponent",
            _counted_driver(study),
        ),
    )  # fmt: skip


def _counted_driver(study: StudyResults) -> str:
    trials = [group.trials for group in study.models]
    is_equal = all((of["model_left"] == of["model_right"]).all() for of in trials)
    if is_equal and all(of["focal"].isna().all() for of in trials):
        return LEFT[1]
    every = pd.concat(trials)
    given = [
        factor
        for factor, levels in texts_of(study).items()
        if any(text.given_to != "both" for text in levels.values())
    ]
    words = f"the words of {' or '.join(given)}" if given else "a level's words or settings"
    alone = f"the one that alone gets {words}, else " if every["focal"].notna().any() else ""
    sides = every.loc[~have_same_prompts(every), "ego"].value_counts()
    left, right = (int(sides.get(side, 0)) for side in SIDES)
    where = "left and right equally often"
    if left != right:
        where = f"on the left in {left} trials, on the right in {right}"
    counted = f"{EGO[1]}: {alone}the one named first, who was {where}"
    return f"{counted}. {HALVES}" if one_sided(study) else counted


def varied(study: StudyResults) -> tuple[str, ...]:
    """Return the factors that a study varies, apart from the driver and its opponent."""
    named = {
        levels[0].factor: len(levels)
        for levels in levels_by_factor(study)
        if levels[0].factor not in (MODEL, OPPONENT)
    }
    kept: list[str] = []
    crossings = 1
    for name, number in named.items():
        crossings *= number
        if crossings <= MOST_CROSSINGS:
            kept.append(name)
    return tuple(kept)


def _every(study: StudyResults) -> Iterator[tuple[str, Level]]:
    """Yield each level of all drivers, then of each driver, then each crossing of each driver."""
    levels = [group.levels for group in study.models]
    drivers = [*dict.fromkeys(named[MODEL] for named in levels if MODEL in named)]
    for of_factor in levels_by_factor(study):
        yield from (("", level) for level in of_factor)
    for driver in drivers:
        for of_factor in levels_by_factor(study, MODEL, driver):
            yield from ((driver, level) for level in of_factor)
    factors = varied(study)
    if len(factors) < 2:
        return
    for driver, names in product(drivers, product(*_names(study, factors))):
        chosen = {MODEL: driver, **dict(zip(factors, names, strict=True))}
        yield from ((driver, level) for level in crossing(study, factors, chosen))


def _names(study: StudyResults, factors: tuple[str, ...]) -> list[list[str]]:
    names: dict[str, dict[str, None]] = {factor: {} for factor in factors}
    for of_factor in levels_by_factor(study):
        if of_factor[0].factor in names:
            names[of_factor[0].factor] |= dict.fromkeys(level.name for level in of_factor)
    return [[*known] for known in names.values()]


def _row(study: StudyResults, level: Level, driver: str, metric: Metric) -> Row:
    group, shown = level.pooled, level_estimate(study, level, metric)
    crashed, ended = counts(group, COLLISIONS)
    values: dict[str, Value] = {
        "factor": level.factor,
        "level": f"{level.name}{level.mark}",
        "driver": driver or None,
        "k": shown.k if metric.rate else None,
        "n": shown.n,
        "value": shown.value,
        "ci": shown.bounds(),
        "repeated": _repeated(study, level, driver, len(group.ended)),
        "crashed": crashed,
        "ended": ended,
        "gap_m": estimate(group, GAP).value,
        "rmse_mps": estimate(group, RMSE).value,
    }
    name = f"{driver}/" * bool(driver) + f"{level.factor}={level.name}{level.mark}"
    return Row(name, level.groups, values, "", metric.column, copies=level.copies)


def _repeated(study: StudyResults, level: Level, driver: str, ended: int) -> int | None:
    """Return the number of a level's ended trials that are left out as copies."""
    if TIMES in level.factor:
        return None
    of_level = [
        group
        for group in study.models
        if group.scripted == level.pooled.scripted
        and group.levels.get(level.factor) == level.name
        and group.levels.get(MODEL) in (driver or group.levels.get(MODEL), None)
    ]
    return sum(len(group.stored.ended) for group in of_level) - ended
