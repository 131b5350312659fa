"""Table VII and the criticality of conflicts: metrics of every driver and prompt."""

from __future__ import annotations

from merge_runner.scenarios.merge.measures import NO_CONFLICT_MPS
from merge_runner_analysis.data.study import Group, Study
from merge_runner_analysis.metrics import (
    RULES_NOTE,
    Bounded,
    HumanReference,
    Metric,
    intervals_of,
    shown_in,
)
from merge_runner_analysis.stats.measures import (
    estimate_or_reference,
    no_human_value,
    outcomes_note,
    undecided_note,
)
from merge_runner_analysis.tables.model import (
    ENDED,
    GROUP_COLUMNS,
    Column,
    Row,
    Table,
    interval,
    row_of,
)


def ablation_quantitative(study: Study) -> Table:
    """Table VII: collisions, gap, RMSE and joint rate of every driver and prompt."""
    return _table("ablation-quantitative", study.groups, shown_in("tables"), RULES_NOTE)


def criticality(study: Study) -> Table:
    """Surrogate measures of safety of every group whose traces are known."""
    note = (
        "a conflict is resolved when no vehicle, at its present speed, would meet the other at the "
        "first possible contact, the merge point or the end of the track; vehicles that after the "
        f"merge never close in faster than {NO_CONFLICT_MPS} m/s are in no conflict, and have no "
        "time to collision"
    )
    return _table("criticality", study.measured, shown_in("criticality"), note)


def _table(name: str, groups: list[Group], metrics: list[Metric], note: str) -> Table:
    columns = [*GROUP_COLUMNS, Column("n", "n", "count", 0, "trials that ended")]
    for metric in metrics:
        counts = metric.column if metric.rate else ""
        columns += [
            Column(
                metric.name, metric.heading, metric.kind, metric.decimals, metric.meaning, counts
            ),
            interval(f"{metric.name}_ci", f"of {metric.label}", metric.decimals),
        ]
    ended = ", ".join(metric.heading for metric in metrics if metric.trials == "ended")
    rest = "of the finished trials that have the measure"
    trials = f"{ended}: of all trials that ended; the rest: {rest}" if ended else rest
    notes = (trials, f"intervals: {intervals_of(metrics)}", note)
    return Table(name, columns, [_row(group, metrics) for group in groups], notes)


def _row(group: Group, metrics: list[Metric]) -> Row:
    found, remarks = measured(group, metrics)
    values = {name: one.value for name, one in found.items()}
    intervals = {f"{name}_ci": one.bounds() for name, one in found.items()}
    n = len(group.ended_outcomes)
    return row_of(group, {"n": n, **values, **intervals}, *remarks, counts=ENDED)


def measured(group: Group, metrics: list[Metric]) -> tuple[dict[str, Bounded], list[str]]:
    """What a group comes to by each metric, and remarks on those that are published or missing."""
    found: dict[str, Bounded] = {}
    remarks = [outcomes_note(group)]
    reasons: dict[str, list[str]] = {}
    for metric in metrics:
        one = estimate_or_reference(group, metric)
        if one is None:
            remarks.append(no_human_value(metric))
            continue
        found[metric.name] = one
        if isinstance(one, HumanReference):
            why = f"published, no human traces are imported ({one.source})"
            reasons.setdefault(why, []).append(metric.heading)
        elif one.value is None and one.bounds() is None:
            reasons.setdefault("no trial has it", []).append(metric.heading)
        else:
            remarks.append(undecided_note(group, metric))
    remarks += [f"{', '.join(headings)}: {why}" for why, headings in reasons.items()]
    return found, remarks
