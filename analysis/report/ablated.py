"""What each driver's prompt variants change: a sentence of one form for each variant."""

from __future__ import annotations

from collections.abc import Iterator

from merge_runner_analysis.data.study import Group, Study
from merge_runner_analysis.metrics import Metric, compared
from merge_runner_analysis.stats.indicators import ALPHA
from merge_runner_analysis.tables import finished_tables
from merge_runner_analysis.tables.model import Row
from merge_runner_analysis.tables.notes import listed

DETECTABLE = (
    "That does not show that the others are equal: the table contrasts has the smallest difference "
    "that could be found."
)


def ablation_sentences(study: Study) -> list[str]:
    """What is shown about the variants of each driver, except those that stand-ins answered."""
    references = {group.driver: group for group in study.models if group.setting == study.reference}
    groups = [
        group for group in study.models if group.setting != study.reference and not group.scripted
    ]
    if not groups:
        return []
    # The sentences quote the table's values, so that text and table cannot disagree.
    (table,) = finished_tables(study.db, None, ["contrasts"], study)
    rows = {row.id: row for row in table.rows}
    return [
        f"{group.label}, {group.setting}: {_said(group, references.get(group.driver), study, rows)}"
        for group in groups
    ]


def _said(group: Group, reference: Group | None, study: Study, rows: dict[str, Row]) -> str:
    if (group.trials["source"] == "driver").all():
        return "a program reads no prompt, and the variant can change nothing."
    if reference is None:
        return f"there is no prompt {study.reference} to compare with: no change can be stated."
    found = {
        metric: row
        for metric in compared()
        if (row := rows.get(f"{group.id}/{study.reference}/{metric.name}")) is not None
    }
    differing = {metric: row for metric, row in found.items() if _p(row) < ALPHA}
    sizes = f"({len(group.ended)} trials against {len(reference.ended)})"
    changes = f": {listed([*_changes(differing)])}" if differing else ""
    text = (
        f"after Holm's correction {len(differing)} of {len(found)} measures differ from "
        f"{study.reference} {sizes}{changes}."
    )
    if lacking := [metric.in_sentences for metric in compared() if metric not in found]:
        text += f" Not compared: {listed(lacking)}, for the reasons that the table contrasts notes."
    return f"{text} {DETECTABLE}" if len(differing) < len(found) else text


def _p(row: Row) -> float:
    p = row.values["p_holm"]
    assert isinstance(p, float)
    return p


def _changes(differing: dict[Metric, Row]) -> Iterator[str]:
    """``the gap by -2.40 m (95 % CI -3.23 to -1.57)``."""
    for metric, row in differing.items():
        difference, ci = row.values["difference"], row.values["ci"]
        assert isinstance(difference, float)
        assert isinstance(ci, tuple)
        low, high = ci
        unit = "points" if metric.rate else metric.unit
        yield (
            f"{metric.in_sentences} by {difference:+.2f} {unit} (95 % CI {low:+.2f} to {high:+.2f})"
        )
