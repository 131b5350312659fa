"""What each level of a study's factors comes to, pooled over all other factors."""

from __future__ import annotations

from collections.abc import Iterator

from analysis.data.study import Study
from analysis.metrics import METRICS, RULES_NOTE, Metric, intervals_of
from analysis.stats.factors import Level, balance, difference, levels_by_factor
from analysis.stats.measures import estimate, undecided
from analysis.tables.model import Column, Row, Table, Value
from analysis.tables.notes import sample_notes


def factors(study: Study) -> Table:
    """A row per factor, measure and level: the level's value, and how far it is from the first."""
    found = levels_by_factor(study)
    return Table(
        "factors",
        "Each factor's levels, pooled over all other factors",
        (
            Column("factor", "factor"),
            Column("drivers", "drivers", optional=True),
            Column("measure", "measure"),
            Column("level", "level"),
            Column(
                "trials",
                "trials",
                "count",
                0,
                "trials of the level that ended",
                "status <> 'failed'",
            ),
            Column("n", "n", "count", 0, "of these, trials that count for the measure"),
            Column("value", "value", "number", 2, "the measure", optional=True),
            Column("ci", "95 % CI", "interval", 2, "of the measure", optional=True),
            Column(
                "difference",
                "difference",
                "number",
                2,
                "from the factor's first level",
                optional=True,
                of="both",
            ),
            Column(
                "difference_ci",
                "95 % CI",
                "interval",
                2,
                "of the difference",
                optional=True,
                of="both",
            ),
            Column(
                "p", "p", "p", 3, "Fisher's exact or permutation test", optional=True, of="both"
            ),
        ),
        [row for levels in found for row in _rows(levels)],
        (
            *([] if found else ["the trials of drivers differ in no factor"]),
            f"intervals: {intervals_of(METRICS.values())}. Differences of rates: of the pooled "
            "rates, Newcombe's interval and Fisher's test; of means: within cells (a condition "
            "with one level of each other factor), least squares and a seeded permutation test; "
            "of medians: without a test. p is not corrected",
            *(f"{levels[0].factor}{levels[0].mark}: {balance(levels)}" for levels in found),
            RULES_NOTE,
            *sample_notes(study, study.models),
        ),
    )


def _rows(levels: list[Level]) -> Iterator[Row]:
    for metric in METRICS.values():
        for level in levels:
            yield _row(level, levels[0], metric)


def _row(level: Level, first: Level, metric: Metric) -> Row:
    found = estimate(level.pooled, metric)
    cells: dict[str, Value] = {
        "factor": level.factor,
        "drivers": level.posing or None,
        "measure": metric.heading,
        "level": level.name,
        "trials": len(level.pooled.ended),
        "n": found.n,
        "value": found.value,
        "ci": found.bounds(),
    }
    if level is not first:
        cells |= _compared(level, first, metric)
    nothing = "" if found.n else f"{metric.heading}: no trial with this measure"
    return Row(
        f"{level.id}/{metric.name}",
        level.groups,
        cells,
        "; ".join(filter(None, (nothing, undecided(level.pooled, metric)))),
        counts=metric.counts,
        references=() if level is first else first.groups,
    )


def _compared(level: Level, first: Level, metric: Metric) -> dict[str, Value]:
    if metric.estimator == "median":
        one, other = (estimate(each.pooled, metric).value for each in (level, first))
        return {} if one is None or other is None else {"difference": one - other}
    found, unit = difference(level, first, metric), 100 if metric.rate else 1
    if found is None:
        return {}
    return {
        "difference": unit * found.value,
        "difference_ci": found.bounds(unit),
        "p": found.p,
    }
