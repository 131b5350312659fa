"""Outcomes under several readings of the paper's collision rule, and under that for humans."""

from __future__ import annotations

from collections.abc import Iterator

import pandas as pd

from analysis.data.collision_rules import BOXES, READINGS, UNDECIDED, outcomes
from analysis.data.load import load_each
from analysis.data.study import Group, Study, of_group
from analysis.stats.intervals import proportion
from analysis.tables.model import GROUP_COLUMNS, Column, Row, Table, Value, row_of
from analysis.tables.notes import measured_notes

# The size of the vehicles under each spec, in words.
SIZES = "SELECT spec_hash, format('{:g} m x {:g} m', length_m, width_m) AS size FROM geometry"


def robustness(study: Study) -> Table:
    """A row per group and rule: collisions, who was first, and what remains undecided."""
    rows: list[Row] = []
    if study.measured:
        found = outcomes(study.db, pd.concat([group.trials for group in study.measured]))
        rows = [row for group in study.measured for row in _rows(group, found)]
    everything = "status <> 'failed'"
    return Table(
        "robustness",
        "Outcomes under the readings of the collision rule, from the stored plans",
        (
            *GROUP_COLUMNS,
            Column("rule", "rule"),
            Column("n", "n", "count", 0, "trials that ended", everything),
            Column("collided", "collided", "count", 0, "trials that collide", everything),
            Column("collided_percent", "(%)", "percent", 2, "of n", everything),
            Column("collided_percent_ci", "95 % CI", "interval", 2, "Wilson", everything),
            Column("finished", "finished", "count", 0, "trials that finish", everything),
            Column("timeout", "timeout", "count", 0, "trials nobody finishes", everything),
            Column(UNDECIDED, UNDECIDED, "count", 0, "trials whose plans end first", everything),
            Column("left_first", "left first", "count", 0, "finished, left first", everything),
        ),
        rows,
        (
            "euclid2d: centres closer than a vehicle length in the plane; rectangle: the vehicles' "
            "boxes overlap; shared_lane: closer than a vehicle length along the track once either "
            "vehicle has passed the merge point. They are looked for at the steps of the "
            f"simulation, of humans every 0.2 s. {BOXES}: the rule of the human experiment",
            *_size_notes(study),
            "undecided: the trial ended in a collision that this rule does not see, and the last "
            "plans, or the human trace, end before it is decided",
            *measured_notes(study),
        ),
    )


def _size_notes(study: Study) -> Iterator[str]:
    """The vehicles' sizes, with the groups that drove them where sizes differ."""
    found = load_each({"sizes": SIZES}, study.db)["sizes"].set_index("spec_hash")["size"]
    driven: dict[str, list[str]] = {}
    for group in study.measured:
        for size in found.reindex(group.trials["spec_hash"].unique()).dropna().unique():
            driven.setdefault(size, []).append(group.id)
    for size, ids in driven.items():
        of = f"{', '.join(ids)}: " if len(driven) > 1 else ""
        yield f"{of}the vehicles are {size}"


def _rows(group: Group, found: pd.DataFrame) -> list[Row]:
    # All trials that ended, as one that finished under its own rule may collide under another.
    own = of_group(found, group, group.ended)
    rows = []
    for rule in READINGS:
        chosen = own[own["rule"] == rule]
        counts = chosen["status"].value_counts()
        collided, n = int(counts.get("collided", 0)), len(chosen)
        share = proportion(collided, n)
        values: dict[str, Value] = {
            "rule": rule,
            "n": n,
            "collided": collided,
            **{name: int(counts.get(name, 0)) for name in ("finished", "timeout", UNDECIDED)},
            "left_first": int(
                ((chosen["status"] == "finished") & (chosen["merged_first"] == "left")).sum()
            ),
        }
        # Undecided trials stay in n: the share is a lower bound.
        note = "no trial ended"
        if share.value is not None:
            values |= {
                "collided_percent": 100 * share.value,
                "collided_percent_ci": share.bounds(100),
            }
            note = ""
        rows.append(row_of(group, values, note, item=rule))
    return rows
