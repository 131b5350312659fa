"""Differences between prompts, and between the levels of factors; for humans see ``verdicts``."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from itertools import product
from math import isinf

from merge_runner.registry import require
from merge_runner.text_safety import quoted
from merge_runner_analysis.data.study import Group, Study, levels_of
from merge_runner_analysis.metrics import METRICS, RULES_NOTE, Metric, intervals_of, shown_in
from merge_runner_analysis.stats.contrasts import contrast, corrected
from merge_runner_analysis.stats.factors import (
    Level,
    balance,
    difference,
    difference_of_medians,
    levels_by_factor,
)
from merge_runner_analysis.stats.intervals import Difference
from merge_runner_analysis.stats.measures import estimate, trials_of, undecided_note
from merge_runner_analysis.tables.model import Column, Optional, Row, Table, Value, interval

WITHIN = (
    "compared within the {} that both have: rates by the weights of Mantel and Haenszel, with "
    "Newcombe's interval and Fisher's exact test; means by least squares, with its t test"
)
DIFFERENCES = (
    f"Levels are {WITHIN.format('cells')}; medians without a test. The reference is the level that "
    "stands first; a cell is a condition with one level of each other factor. Where a level lacks "
    "cells, there is no p"
)
INTERACTIONS = (
    "an interaction (×) is the difference at that level minus the one at the first level of {by}, "
    "in the cells that all four have: of rates by Newcombe's intervals, p being the level at which "
    "they exclude 0; of means by Welch's t test"
)
NO_INTERACTION = (
    "no interaction without cells that all four have, spread within cells, or with undecided trials"
)


def contrasts(study: Study) -> Table:
    """Every prompt against its driver's reference."""
    # A family is one question asked of several variants. Correcting over all metrics at once would
    # make the result depend on how many are registered.
    rows = [
        row
        for driver in dict.fromkeys(group.driver for group in study.models)
        for metric in shown_in("tables")
        if metric.estimator != "median"
        for row in _family(study, driver, metric)
    ]
    judged = "judged " if study.unjudged else ""
    return Table(
        "contrasts",
        (
            Column("driver", "driver"),
            Column("setting", "setting"),
            Column("reference", "against"),
            Column("measure", "measure"),
            Column("difference", "difference", "number", 2, "first minus second"),
            interval("ci", "Newcombe; least squares"),
            Column("p", "p", "p", 3, "Fisher's exact test or t test"),
            Column("p_holm", "Holm", "p", 3, "corrected by Holm"),
            Optional("detectable", "detectable", "number", 2, "at p < .05 with power .8"),
            Column("n", "n", "count", 0, "trials of the setting in the shared conditions"),
            Column("n_reference", "n ref.", "count", 0, "trials of the reference in these"),
            Optional("freedom", "df", "number", 0, "of a t test"),
        ),
        rows,
        (
            f"{WITHIN.format('conditions')}. A family is one measure of one driver over its "
            "prompts. Detectable: before correction; of rates by the exact power of Fisher's test "
            "of all these trials as if of one condition, in the direction in which less is enough, "
            "of means (t.975 + t.8) times the standard error",
            RULES_NOTE,
            *([] if rows else [f"there is no pair of {judged}groups to compare"]),
        ),
    )


def _family(study: Study, driver: str, metric: Metric) -> Iterator[Row]:
    """One measure of a driver's prompts against its reference; p are corrected for their number."""
    groups = {group.setting: group for group in study.models if group.driver == driver}
    other = groups.pop(study.reference, None)
    found = [
        (group, other, difference)
        for group in groups.values()
        if other and (difference := contrast(study, (group, other), metric))
    ]
    for pair, p in zip(found, corrected([difference.p for *_, difference in found]), strict=True):
        yield _prompt_row(*pair, metric, p)


def _prompt_row(group: Group, other: Group, found: Difference, metric: Metric, holm: float) -> Row:
    first, second = (
        trials_of(one, metric).dropna(subset=[metric.column])["condition"] for one in (group, other)
    )
    named = ", ".join(quoted(name) for name in sorted({*first} & {*second}))
    factor, least = 100 if metric.rate else 1, found.detectable
    return Row(
        f"{group.id}/{other.setting}/{metric.name}",
        (group.id, other.id),
        {
            "driver": group.label,
            "setting": group.setting,
            "reference": other.setting,
            "measure": metric.heading,
            "difference": factor * found.value,
            "ci": found.bounds(factor),
            "p": found.p,
            "p_holm": holm,
            "detectable": None if least is None else factor * least,
            "n": int(first.isin(second).sum()),
            "n_reference": int(second.isin(first).sum()),
            "freedom": None if isinf(found.freedom) else found.freedom,
        },
        f"{metric.heading}: so few trials can show no difference, however large"
        if least is None
        else "",
        f"{metric.counts} AND condition IN ({named})",
    )


def factors(study: Study) -> Table:
    """A row per factor, measure and level: the level's value, and how far it is from the first.

    Where the study is shown by a factor, each of its levels has rows of its own, and interactions.
    """
    by = study.by or ""
    shown = require(levels_of(study.models, study.order), "factor", by) if by else [""]
    found = [levels for at in shown for levels in levels_by_factor(study, by, at)]
    rows = [
        _level_row(study, level, levels[0], metric)
        for levels in found
        for metric in METRICS.values()
        for level in levels
    ]
    rows += _interactions(study, found) if by else []
    p = {row.id: value for row in rows if isinstance(value := row.values.get("p"), float)}
    holm = dict(zip(p, corrected([*p.values()]), strict=True))
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
        [replace(row, values={**row.values, "p_holm": holm.get(row.id)}) for row in rows],
        (
            *([] if found else [f"the trials of {judged}drivers differ in no factor"]),
            f"intervals: {intervals_of(METRICS.values())}. {DIFFERENCES}",
            *([INTERACTIONS.format(by=by)] if by else []),
            *([f"Holm: corrected for all {len(p)} p of the table"] if p else []),
            *(f"{_name(levels[0])}: {balance(levels)}" for levels in found),
            RULES_NOTE,
        ),
    )


def _name(level: Level) -> str:
    return f"{level.factor}{level.mark}" + (f" at {level.at}" if level.at else "")


def _level_row(study: Study, level: Level, first: Level, metric: Metric) -> Row:
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
