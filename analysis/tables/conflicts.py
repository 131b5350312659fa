"""How conflicts are resolved: when, and how close the vehicles come to a collision."""

from __future__ import annotations

from merge_runner.scenarios.merge.conditions import HUMAN_CONDITIONS
from merge_runner.scenarios.merge.measures import NO_CONFLICT_MPS
from merge_runner.text_safety import quoted
from merge_runner_analysis.data.reference_data import citation, published
from merge_runner_analysis.data.study import Group, Study
from merge_runner_analysis.metrics import shown_in
from merge_runner_analysis.stats.measures import values
from merge_runner_analysis.tables.model import GROUP_COLUMNS, Column, Row, Table, Value, row_of
from merge_runner_analysis.tables.notes import measured_notes, sample_notes

# Quartiles, since the human times are published as these; named as the columns of that file.
QUARTILES = {"crt_q1_s": 0.25, "crt_median_s": 0.5, "crt_q3_s": 0.75}


def conflict_resolution(study: Study) -> Table:
    """A row per baseline and condition: quartiles of the conflict resolution time."""
    resolved = "conflict_resolution_s IS NOT NULL"
    meaning = "of the time until the vehicles are first off a collision course"
    return Table(
        "conflict-resolution",
        "Conflict resolution time (s) by condition",
        (
            Column("condition", "condition"),
            Column("driver", "driver"),
            Column("n", "n", "count", 0, "trials that resolved the conflict", resolved),
            *(
                Column(name, heading, "number", 2, f"{heading} {meaning}", resolved)
                for name, heading in zip(
                    QUARTILES, ("first quartile", "median", "third quartile"), strict=True
                )
            ),
        ),
        [
            _resolution(group, name)
            for name in study.conditions
            for group in study.baselines
            # Humans have no setting, and no row in conditions that none of them drove.
            if group.setting or name in HUMAN_CONDITIONS
        ],
        (
            "from the start of control until no vehicle, at its present speed, would meet the "
            "other at the first possible contact, the merge point or the end of the track",
            *sample_notes(study, study.baselines),
        ),
    )


def criticality(study: Study) -> Table:
    """A row per group: medians and quartiles of surrogate safety measures of finished trials."""
    columns = [*GROUP_COLUMNS]
    for metric in shown_in("criticality"):
        name, digits, counts = metric.name, metric.decimals, metric.counts
        columns += [
            Column(name, metric.heading, metric.kind, digits, metric.meaning, counts),
            Column(f"{name}_quartiles", "quartiles", "interval", digits, "", counts, True),
            Column(f"{name}_n", "n", "count", 0, "trials that have it", counts),
        ]
    return Table(
        "criticality",
        "Time to merge, post-encroachment time, time to collision and hardest acceleration",
        columns,
        [_criticality(group) for group in study.measured],
        (
            "medians and quartiles of the finished trials that have the measure; vehicles that "
            f"after the merge never close in faster than {NO_CONFLICT_MPS} m/s are in no conflict "
            "and have no time to collision",
            *measured_notes(study),
        ),
    )


def _resolution(group: Group, condition: str) -> Row:
    key: dict[str, Value] = {"condition": condition}
    where = f"condition = {quoted(condition)} AND conflict_resolution_s IS NOT NULL"
    if not group.measured:
        printed = published("human_outcomes").set_index("condition").loc[condition]
        cells = {name: float(printed[name]) for name in QUARTILES}
        n = int(printed["left_first"] + printed["right_first"])
        note = f"published, not from traces ({citation('human_outcomes')})"
        return row_of(group, {**key, "n": n, **cells}, note, item=condition)
    known = group.ended.loc[group.ended["condition"] == condition, "conflict_resolution_s"].dropna()
    note = "" if len(known) else f"{condition}: no trial that resolved the conflict"
    cells = {name: float(known.quantile(q)) for name, q in QUARTILES.items() if len(known)}
    return row_of(group, {**key, "n": len(known), **cells}, note, item=condition, counts=where)


def _criticality(group: Group) -> Row:
    cells: dict[str, Value] = {}
    missing = []
    for metric in shown_in("criticality"):
        found = values(group, metric)
        cells[f"{metric.name}_n"] = len(found)
        if found.empty:
            missing.append(metric.heading)
            continue
        # The spread of the trials, not a confidence interval of the median.
        low, middle, high = (float(found.quantile(q)) for q in QUARTILES.values())
        cells |= {metric.name: middle, f"{metric.name}_quartiles": (low, high)}
    note = f"no finished trial with {', '.join(missing)}" if missing else ""
    return row_of(group, cells, note)
