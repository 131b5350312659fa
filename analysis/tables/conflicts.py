"""How conflicts are resolved: when, and how close the vehicles come to a collision."""

from __future__ import annotations

from merge_runner.scenarios.merge.measures import NO_CONFLICT_MPS
from merge_runner_analysis.data.study import Group, Study
from merge_runner_analysis.metrics import shown_in
from merge_runner_analysis.stats.measures import values
from merge_runner_analysis.tables.model import GROUP_COLUMNS, Column, Row, Table, Value, row_of
from merge_runner_analysis.tables.notes import measured_notes


def criticality(study: Study) -> Table:
    """A row per group: medians and quartiles of surrogate safety measures of finished trials."""
    columns = [*GROUP_COLUMNS]
    for metric in shown_in("criticality"):
        name, digits = metric.name, metric.decimals
        columns += [
            Column(name, metric.heading, metric.kind, digits, metric.meaning),
            Column(f"{name}_quartiles", "quartiles", "interval", digits, optional=True),
            Column(f"{name}_n", "n", "count", 0, "trials that have it", metric.counts),
        ]
    return Table(
        "criticality",
        columns,
        [_row(group) for group in study.measured],
        (
            "medians and quartiles of the finished trials that have the measure. A conflict is "
            "resolved when no vehicle, at its present speed, would meet the other at the first "
            "possible contact, the merge point or the end of the track; vehicles that after the "
            f"merge never close in faster than {NO_CONFLICT_MPS} m/s are in no conflict, and have "
            "no time to collision",
            *measured_notes(study),
        ),
    )


def _row(group: Group) -> Row:
    cells: dict[str, Value] = {}
    missing = []
    for metric in shown_in("criticality"):
        found = values(group, metric)
        cells[f"{metric.name}_n"] = len(found)
        if found.empty:
            missing.append(metric.heading)
            continue
        # The spread of the trials, not a confidence interval of the median.
        low, middle, high = (float(found.quantile(q)) for q in (0.25, 0.5, 0.75))
        cells |= {metric.name: middle, f"{metric.name}_quartiles": (low, high)}
    note = f"no finished trial with {', '.join(missing)}" if missing else ""
    return row_of(group, cells, note)
