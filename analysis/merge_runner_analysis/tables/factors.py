"""The levels of factors: every metric, and the difference from the reference."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from itertools import product

from merge_runner.registry import require
from merge_runner_analysis.grouping import levels_of
from merge_runner_analysis.metrics import INTERVALS, METRICS, RULES_NOTE, Metric
from merge_runner_analysis.stats.contrasts import contrast, copied_of_shared, corrected
from merge_runner_analysis.stats.factors import (
    Level,
    balance,
    difference_of_medians,
    levels_by_factor,
)
from merge_runner_analysis.stats.measures import estimate, undecided_note
from merge_runner_analysis.study import Study
from merge_runner_analysis.tables.contrasts import FAMILY, SAME_TRIALS, WITHIN
from merge_runner_analysis.tables.model import Column, Optional, Row, Table, Value, interval
from merge_runner_analysis.wording import note_of

INTERACTION = " × "
DIFFERENCES = (
    f"Levels are {WITHIN.format('cells')}; medians without a test. The reference is the level that "
    "stands first; a cell is a condition with one level of each other factor"
)
INTERACTIONS = (
    "an interaction (×) is the difference at that level minus the one at the first level of {by}, "
    "in the cells that all four have: of rates by Newcombe's intervals, p being the level at which "
    "they exclude 0; of means by Welch's t test"
)
NO_INTERACTION = (
    "no interaction without cells that all four have, spread within cells, or with undecided "
    "trials or the same ones at two levels"
)


def _left_out(study: Study, level: Level, first: Level) -> str:
    """What is not compared, since programs play the same trials at both levels."""
    copies, shared = copied_of_shared(study, (level.pooled, first.pooled), "cell")
    if not copies:
        return ""
    if copies == shared:
        return SAME_TRIALS
    return (
        f"the difference leaves out {copies} of {shared} shared cells, those of programs that play "
        "the same trials at both levels"
    )


def factors(study: Study) -> Table:
    """A row per factor, measure and level: the level's value, and how far it is from the first.

    Where the study is shown by a factor, each of its levels has rows of its own, and interactions.
    """
    by = study.selection.by or ""
    shown = require(levels_of(study.models, study.order), "factor", by) if by else [""]
    found = [levels for at in shown for levels in levels_by_factor(study, by, at)]
    rows = [
        _level_row(study, level, levels[0], metric)
        for levels in found
        for metric in METRICS.values()
        for level in levels
    ]
    rows += _interactions(study, found) if by else []
    families: dict[tuple[Value, ...], dict[str, float]] = {}
    for row in rows:
        if isinstance(value := row.values.get("p"), float):
            family = tuple(row.values.get(name) for name in ("factor", "drivers", "measure"))
            family += () if INTERACTION in str(family[0]) else (row.values.get("at"),)
            families.setdefault(family, {})[row.id] = value
    holm = {
        name: p_holm
        for p in families.values()
        for name, p_holm in zip(p, corrected([*p.values()]), strict=True)
    }
    rows = [replace(row, values={**row.values, "p_holm": holm.get(row.id)}) for row in rows]
    return Table(
        "factors",
        (
            *([Column("at", by)] if by else []),
            Column("factor", "factor"),
            Optional("drivers", "drivers"),
            Column("measure", "measure"),
            Column("level", "level"),
            Column("trials", "trials", "count", 0, "trials of the level that ended"),
            Column("n", "n", "count", 0, "of these, trials that count for the measure"),
            Optional("value", "value", "number", 2, "the measure"),
            interval("ci", "of the measure"),
            Optional("difference", "difference", "number", 2, "from the factor's reference"),
            interval("difference_ci", "of the difference"),
            Optional("p", "p", "p", 3, "Fisher's exact test or Welch's"),
            Optional("p_holm", "Holm", "p", 3, "corrected by Holm"),
        ),
        rows,
        (
            *([] if found else ["the trials of judged drivers differ in no factor"]),
            f"intervals: {INTERVALS}. {DIFFERENCES}",
            *([INTERACTIONS.format(by=by)] if by else []),
            *([FAMILY] if any(row.values["p_holm"] is not None for row in rows) else []),
            *_copies(found),
            *(f"{_name(levels[0])}: {balance(levels)}" for levels in found),
            RULES_NOTE,
        ),
    )


def _copies(found: list[list[Level]]) -> Iterator[str]:
    """Which levels have copies of trials from levels of other factors."""
    counts = [
        f"{level.id}: {level.pooled.repeated} of {len(level.pooled.stored.trials)}"
        for levels in found
        for level in levels
        if level.pooled.repeated
    ]
    if counts:
        yield (
            f"{', '.join(counts)} trials of programs are equal to others of the level to the last "
            "state, at another level of another factor: each counts once, in one cell"
        )


def _name(level: Level) -> str:
    return f"{level.factor}{level.mark}" + (f" at {level.at}" if level.at else "")


def _level_row(study: Study, level: Level, first: Level, metric: Metric) -> Row:
    found = estimate(level.pooled, metric)
    cells = _cells(level, metric) | {"n": found.n, "value": found.value, "ci": found.bounds()}
    if level is not first and metric.estimator == "median":
        cells |= {"difference": difference_of_medians(study, metric, level, first)}
    elif level is not first:
        cells |= _difference(study, metric, level, first)
    nothing = "" if found.n or found.bounds() else f"{metric.heading}: no trial with this measure"
    same = "" if level is first else _left_out(study, level, first)
    note = note_of(nothing, undecided_note(level.pooled, metric), same)
    row_id = f"{level.id}/{metric.name}"
    return Row(row_id, level.groups, cells, note, metric.column, copies=level.copies)


def _cells(level: Level, metric: Metric) -> dict[str, Value]:
    """What every row of a level says."""
    return {
        "at": level.at.partition("=")[2],
        "factor": level.factor,
        "drivers": "mock" if level.posing else None,
        "measure": metric.heading,
        "level": level.name,
        "trials": len(level.pooled.ended),
    }


def _difference(study: Study, metric: Metric, *levels: Level) -> dict[str, Value]:
    """A difference of levels, or of differences, in the cells that all of them have."""
    found = contrast(study, [level.pooled for level in levels], metric, "cell")
    if found is None:
        return {}
    found = found.times(100 if metric.rate else 1)
    return {"difference": found.value, "difference_ci": found.bounds(), "p": found.p}


def _interactions(study: Study, found: list[list[Level]]) -> Iterator[Row]:
    """A row for each level of a factor at each level of the other one, but for their references."""
    known: dict[tuple[str, str], list[list[Level]]] = {}
    for levels in found:
        known.setdefault((levels[0].factor, levels[0].mark), []).append(levels)
    tested = [metric for metric in METRICS.values() if metric.estimator != "median"]
    for ((base, *twins), *more), metric in product(known.values(), tested):
        for (first, *levels), twin in product(more, twins):
            for level in levels:
                if level.name == twin.name and first.name == base.name:
                    yield _interaction(study, level, first, twin, base, metric)


def _interaction(
    study: Study, level: Level, first: Level, twin: Level, base: Level, metric: Metric
) -> Row:
    by, _, at = level.at.partition("=")
    different = _difference(study, metric, level, first, twin, base)
    cells = _cells(level, metric) | {
        "at": f"{at} - {base.at.partition('=')[2]}",
        "factor": f"{level.factor}{INTERACTION}{by}",
        "n": estimate(level.pooled, metric).n,
        **different,
    }
    note = "" if different else f"{metric.heading}: {NO_INTERACTION}"
    row_id = f"{level.id}/interaction/{metric.name}"
    return Row(row_id, level.groups, cells, note, metric.column, copies=level.copies)
