"""Table VII: the metrics of every driver and prompt."""

from __future__ import annotations

from merge_runner_analysis.grouping import Group
from merge_runner_analysis.metrics import INTERVALS, RULES_NOTE, Metric, shown_in
from merge_runner_analysis.stats import measures
from merge_runner_analysis.stats.estimate import Estimate
from merge_runner_analysis.study import StudyResults
from merge_runner_analysis.tables.model import (
    ENDED,
    GROUP_COLUMNS,
    Column,
    Kind,
    Optional,
    Table,
    Value,
    interval,
    row_of,
)


def ablation_quantitative(study: StudyResults) -> Table:
    """Return Table VII: collisions, gap, RMSE and joint rate of every driver and prompt."""
    ended = ", ".join(metric.heading for metric in shown_in("tables") if metric.trials == "ended")
    trials = f"{ended}: of all trials that ended; the rest: of the finished ones"
    return metric_table("ablation-quantitative", study.groups, "tables", trials, RULES_NOTE)


def metric_table(name: str, groups: list[Group], place: str, *notes: str) -> Table:
    """Return a row for each group, with the metrics that a place of ``metrics.SHOWN`` has."""
    metrics = shown_in(place)
    columns = [*GROUP_COLUMNS, Column("n", "n", "count", "trials that ended")]
    for metric in metrics:
        kind: Kind = "percent" if metric.rate else "number"
        counts = metric.column if metric.rate else ""
        meaning, rests_on = metric.meaning, metric.column
        if metric.estimator == "median":
            of = f"{metric.trials} trials that have the measure"
            meaning = f"median over the {of}: {meaning}"
            heading = f"n, {metric.label}"
            columns.append(Optional(f"{metric.name}_n", heading, "count", of, rests_on=rests_on))
        columns += [
            Column(metric.name, metric.heading, kind, meaning, counts, rests_on=rests_on),
            interval(f"{metric.name}_ci", f"of {metric.label}", rests_on=rests_on),
        ]
    rows = []
    for group in groups:
        estimates, remarks = measured(group, metrics)
        values: dict[str, Value] = {"n": len(group.ended_outcomes)}
        for measure, estimate in estimates.items():
            values |= {measure: estimate.value, f"{measure}_ci": estimate.bounds()}
            values[f"{measure}_n"] = estimate.n or None
        rows.append(row_of(group, values, *remarks, rests_on=ENDED))
    return Table(name, columns, rows, (f"intervals: {INTERVALS}", *notes))


def measured(group: Group, metrics: list[Metric]) -> tuple[dict[str, Estimate], list[object]]:
    """Return a group's estimates by metric, and remarks on published or missing ones."""
    estimates: dict[str, Estimate] = {}
    remarks: list[object] = [measures.outcomes_note(group)]
    reasons: dict[str, list[str]] = {}
    for metric in metrics:
        estimate = measures.estimate_or_reference(group, metric)
        if estimate is None:
            remarks.append(measures.no_human_value(metric))
            continue
        estimates[metric.name] = estimate
        if estimate.source:
            reasons.setdefault(str(estimate.source), []).append(metric.heading)
        elif estimate.value is None and estimate.bounds() is None:
            reasons.setdefault("no trial has it", []).append(metric.heading)
        else:
            remarks.append(measures.undecided_note(group, metric))
    return estimates, [*remarks, *(f"{', '.join(names)}: {why}" for why, names in reasons.items())]
