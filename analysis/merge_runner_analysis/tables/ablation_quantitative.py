"""Table VII: the metrics of every driver and prompt."""

from __future__ import annotations

from merge_runner_analysis.grouping import Group
from merge_runner_analysis.metrics import (
    INTERVALS,
    RULES_NOTE,
    Metric,
    shown_in,
)
from merge_runner_analysis.stats.estimate import Estimate
from merge_runner_analysis.stats.measures import (
    estimate_or_reference,
    no_human_value,
    outcomes_note,
    undecided_note,
)
from merge_runner_analysis.study import Study
from merge_runner_analysis.tables.model import (
    ENDED,
    GROUP_COLUMNS,
    Column,
    Kind,
    Optional,
    Table,
    interval,
    row_of,
)


def ablation_quantitative(study: Study) -> Table:
    """Table VII: collisions, gap, RMSE and joint rate of every driver and prompt."""
    ended = ", ".join(one.heading for one in shown_in("tables") if one.trials == "ended")
    trials = f"{ended}: of all trials that ended; the rest: of the finished ones"
    return metric_table("ablation-quantitative", study.groups, "tables", trials, RULES_NOTE)


def metric_table(name: str, groups: list[Group], place: str, *notes: str) -> Table:
    """A row for each group, with the metrics that a place of ``metrics.SHOWN`` has."""
    metrics = shown_in(place)
    columns = [*GROUP_COLUMNS, Column("n", "n", "count", "trials that ended")]
    for one in metrics:
        kind: Kind = "percent" if one.rate else "number"
        counts = one.column if one.rate else ""
        meaning, rests_on = one.meaning, ""
        if one.estimator == "median":
            of, rests_on = f"{one.trials} trials that have the measure", one.column
            meaning = f"median over the {of}: {meaning}"
            columns.append(Optional(f"{one.name}_n", "n", "count", of, rests_on=rests_on))
        columns += [
            Column(one.name, one.heading, kind, meaning, counts, rests_on=rests_on),
            interval(f"{one.name}_ci", f"of {one.label}", rests_on=rests_on),
        ]
    rows = []
    for group in groups:
        found, remarks = measured(group, metrics)
        values = {name: one.value for name, one in found.items()}
        intervals = {f"{name}_ci": one.bounds() for name, one in found.items()}
        sizes = {
            f"{one.name}_n": estimate.n or None
            for one in metrics
            if one.estimator == "median" and (estimate := found.get(one.name))
        }
        cells = {"n": len(group.ended_outcomes), **sizes, **values, **intervals}
        rows.append(row_of(group, cells, *remarks, rests_on=ENDED))
    return Table(name, columns, rows, (f"intervals: {INTERVALS}", *notes))


def measured(group: Group, metrics: list[Metric]) -> tuple[dict[str, Estimate], list[object]]:
    """What a group comes to by each metric, and remarks on those that are published or missing."""
    found: dict[str, Estimate] = {}
    remarks: list[object] = [outcomes_note(group)]
    reasons: dict[str, list[str]] = {}
    for metric in metrics:
        one = estimate_or_reference(group, metric)
        if one is None:
            remarks.append(no_human_value(metric))
            continue
        found[metric.name] = one
        if one.source:
            reasons.setdefault(str(one.source), []).append(metric.heading)
        elif one.value is None and one.bounds() is None:
            reasons.setdefault("no trial has it", []).append(metric.heading)
        else:
            remarks.append(undecided_note(group, metric))
    return found, [*remarks, *(f"{', '.join(names)}: {why}" for why, names in reasons.items())]
