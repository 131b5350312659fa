"""What each level of a study's factors comes to, pooled over all other factors."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from itertools import product

from merge_runner.registry import require
from merge_runner_analysis.data.study import Study, levels_of
from merge_runner_analysis.metrics import METRICS, RULES_NOTE, Metric, intervals_of
from merge_runner_analysis.stats.contrasts import corrected
from merge_runner_analysis.stats.factors import (
    Level,
    balance,
    difference,
    difference_of_medians,
    levels_by_factor,
)
from merge_runner_analysis.stats.intervals import Difference
from merge_runner_analysis.stats.measures import estimate, undecided_note
from merge_runner_analysis.tables.model import Column, Optional, Row, Table, Value, interval

DIFFERENCES = (
    "differences are from the reference, the level that stands first, in the cells that both have "
    "(a cell is a condition with one level of each other factor): of rates by the weights of "
    "Mantel and Haenszel, with Newcombe's interval and Fisher's exact test within cells; of means "
    "by least squares with a level for each cell, and its t test; of medians without a test. So "
    "they are within driver and condition; where a level lacks cells, they have no p"
)
INTERACTIONS = (
    "an interaction (×) is the difference at that level minus the one at the first level of {by}, "
    "in the cells that all four have: of rates by Newcombe's intervals, p being the level at which "
    "they exclude 0; of means by Welch's t test"
)
NO_INTERACTION = (
    "no interaction without cells that all four have, spread within cells, or with undecided trials"
)


def factors(study: Study) -> Table:
    """A row per factor, measure and level: the level's value, and how far it is from the first.

    Where the study is shown by a factor, each of its levels has rows of its own, and interactions.
    """
    by = study.by or ""
    shown = [""]
    if by:
        shown = require(levels_of(study.models, study.order), "factor", by)
    found = [levels for at in shown for levels in levels_by_factor(study, by, at)]
    rows = [row for levels in found for row in _rows(study, levels)]
    rows += _interactions(study, found) if by else []
    tested = [row for row in rows if row.values.get("p") is not None]
    judged = "judged " if study.unjudged else ""
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
            Optional("p", "p", "p", 3, "exact or t test"),
            Optional("p_holm", "Holm", "p", 3, "corrected by Holm"),
        ),
        list(_corrected(rows, tested)),
        (
            *([] if found else [f"the trials of {judged}drivers differ in no factor"]),
            f"intervals: {intervals_of(METRICS.values())}. {DIFFERENCES}",
            *([INTERACTIONS.format(by=by)] if by else []),
            *([f"Holm: corrected for all {len(tested)} p of the table"] if tested else []),
            *(f"{_named(levels[0])}: {balance(levels)}" for levels in found),
            RULES_NOTE,
        ),
    )


def _named(level: Level) -> str:
    return f"{level.factor}{level.mark}" + (f" at {level.at}" if level.at else "")


def _corrected(rows: list[Row], tested: list[Row]) -> Iterator[Row]:
    """The rows with their p corrected for the number of all that are ``tested``."""
    p = {row.id: float(str(row.values["p"])) for row in tested}
    holm = dict(zip(p, corrected([*p.values()])[0], strict=True)) if p else {}
    for row in rows:
        extra = {"p_holm": float(holm[row.id])} if row.id in holm else {}
        yield replace(row, values={**row.values, **extra})


def _rows(study: Study, levels: list[Level]) -> Iterator[Row]:
    for metric in METRICS.values():
        for level in levels:
            yield _row(study, level, levels[0], metric)


def _row(study: Study, level: Level, first: Level, metric: Metric) -> Row:
    found = estimate(level.pooled, metric)
    cells = _cells(level, metric) | {"n": found.n, "value": found.value, "ci": found.bounds()}
    if level is not first:
        if metric.estimator == "median":
            cells |= {"difference": difference_of_medians(study, metric, level, first)}
        else:
            found_difference = difference(study, metric, level, first)
            cells |= _difference(found_difference, metric, of=(level, first))
    nothing = "" if found.n or found.bounds() else f"{metric.heading}: no trial with this measure"
    return Row(
        f"{level.id}/{metric.name}",
        level.groups,
        cells,
        "; ".join(filter(None, (nothing, undecided_note(level.pooled, metric)))),
        counts=metric.counts,
    )


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


def _difference(
    found: Difference | None, metric: Metric, of: tuple[Level, ...]
) -> dict[str, Value]:
    """A difference of levels; no p where some of them lack cells that others have."""
    if found is None:
        return {}
    unit = 100 if metric.rate else 1
    return {
        "difference": unit * found.value,
        "difference_ci": found.bounds(unit),
        "p": found.p if len({frozenset(level.cells) for level in of}) == 1 else None,
    }


def _interactions(study: Study, found: list[list[Level]]) -> Iterator[Row]:
    """A row for each level of a factor at each level of the other one, but for their references."""
    known: dict[tuple[str, str], list[list[Level]]] = {}
    for levels in found:
        known.setdefault((levels[0].factor, levels[0].mark), []).append(levels)
    tested = [metric for metric in METRICS.values() if metric.estimator != "median"]
    for (base, *more), metric in product(known.values(), tested):
        twins = {level.name: level for level in base[1:]}
        for first, *levels in more:
            for level in levels:
                if level.name in twins and first.name == base[0].name:
                    others = twins[level.name], base[0]
                    yield _interaction(study, (level, first), others, metric)


def _interaction(
    study: Study, pair: tuple[Level, Level], others: tuple[Level, Level], metric: Metric
) -> Row:
    level, base = pair[0], others[1]
    by, _, at = level.at.partition("=")
    cells = _cells(level, metric) | {
        "at": f"{at} - {base.at.partition('=')[2]}",
        "factor": f"{level.factor} × {by}",
        "n": estimate(level.pooled, metric).n,
    }
    found = difference(study, metric, *pair, *others)
    return Row(
        f"{level.id}/interaction/{metric.name}",
        level.groups,
        cells | _difference(found, metric, of=(*pair, *others)),
        "" if found else f"{metric.heading}: {NO_INTERACTION}",
        metric.counts,
    )
