"""How conflicts are resolved: when, and how close it gets."""

from __future__ import annotations

from analysis.data.reference_data import citation, published
from analysis.data.study import Group, Study
from analysis.tables.model import Column, Row, Table, Value
from analysis.tables.notes import sample_notes
from merge_runner.scenarios.merge.conditions import HUMAN_CONDITIONS
from merge_runner.text_safety import quoted

QUARTILES = {"crt_q1_s": 0.25, "crt_median_s": 0.5, "crt_q3_s": 0.75}
CRITICALITY = {
    "time_to_merge_s": ("time to merge (s)", "until the first vehicle reaches the merge point"),
    "post_encroachment_s": (
        "PET (s)",
        "from when the first vehicle has left the merge point to when the second reaches it",
    ),
    "min_ttc_s": ("min. TTC (s)", "smallest time to collision after the first merge"),
    "max_acceleration_mps2": ("max |a| (m/s²)", "largest absolute acceleration of either vehicle"),
}


def conflict_resolution(study: Study) -> Table:
    """One row a baseline and condition: quartiles of the conflict resolution time."""
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
            if group.setting or name in HUMAN_CONDITIONS
        ],
        (
            "from the start of control until no vehicle, at its present speed, would meet the "
            "other at the first possible contact, the merge point or the end of the track",
            *sample_notes(study, study.baselines),
        ),
    )


def criticality(study: Study) -> Table:
    """One row a group: medians and quartiles of surrogate safety measures of finished trials."""
    measured = [group for group in study.groups if group.measured]
    columns = [Column("driver", "driver"), Column("setting", "setting")]
    for name, (heading, meaning) in CRITICALITY.items():
        counts = f"status = 'finished' AND {name} IS NOT NULL"
        columns += [
            Column(name, heading, "number", 2, meaning, counts),
            Column(f"{name}_quartiles", "quartiles", "interval", 2, "", counts, True),
            Column(f"{name}_n", "n", "count", 0, "trials that have it", counts),
        ]
    return Table(
        "criticality",
        "Time to merge, post-encroachment time, time to collision and hardest acceleration",
        columns,
        [_criticality(group) for group in measured],
        (
            "medians and quartiles of the finished trials that have the measure: one that never "
            "closes in after the merge has no time to collision",
            *([] if measured else ["there is no measured trial to show"]),
            *sample_notes(study, measured),
        ),
    )


def _resolution(group: Group, condition: str) -> Row:
    key: dict[str, Value] = {"condition": condition, "driver": group.label}
    row = f"{group.id}/{condition}"
    where = f"condition = {quoted(condition)} AND conflict_resolution_s IS NOT NULL"
    if not group.measured:
        printed = published("human_outcomes").set_index("condition").loc[condition]
        values = {name: float(printed[name]) for name in QUARTILES}
        n = int(printed["left_first"] + printed["right_first"])
        return Row(
            row,
            (group.id,),
            {**key, "n": n, **values},
            f"published, not from traces ({citation('human_outcomes')})",
        )
    known = group.ended.loc[group.ended["condition"] == condition, "conflict_resolution_s"].dropna()
    note = "" if len(known) else f"{condition}: no trial that resolved the conflict"
    values = {name: float(known.quantile(q)) for name, q in QUARTILES.items() if len(known)}
    return Row(row, (group.id,), {**key, "n": len(known), **values}, note, where)


def _criticality(group: Group) -> Row:
    values: dict[str, Value] = {"driver": group.label, "setting": group.setting}
    missing = []
    for name, (heading, _) in CRITICALITY.items():
        known = group.finished[name].astype(float).dropna()
        values[f"{name}_n"] = len(known)
        if known.empty:
            missing.append(heading)
            continue
        low, middle, high = (float(known.quantile(q)) for q in QUARTILES.values())
        values |= {name: middle, f"{name}_quartiles": (low, high)}
    note = f"no finished trial with {', '.join(missing)}" if missing else ""
    return Row(group.id, (group.id,), values, note)
