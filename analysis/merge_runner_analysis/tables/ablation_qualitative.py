"""Table VI: the indicators of every driver and prompt."""

from __future__ import annotations

from merge_runner_analysis.grouping import Group
from merge_runner_analysis.stats.indicators import score
from merge_runner_analysis.stats.measures import outcomes_note
from merge_runner_analysis.study import StudyResults
from merge_runner_analysis.tables.indicators import (
    NOTES,
    SCORE,
    ceiling_columns,
    ceiling_values,
    no_ceiling,
    reasons,
    verdict_values,
)
from merge_runner_analysis.tables.model import (
    ENDED,
    GROUP_COLUMNS,
    Column,
    Optional,
    Row,
    Table,
    Value,
    row_of,
)
from merge_runner_analysis.wording import INDICATORS


def ablation_qualitative(study: StudyResults) -> Table:
    """Return Table VI: I1 to I5 of every driver and prompt."""
    columns = [*GROUP_COLUMNS, Column("n", "n", "count", "trials that ended")]
    for name, text in INDICATORS.items():
        prefix = name.lower()
        columns += [
            Optional(f"{prefix}_paper", name, "verdict", meaning=text),
            Optional(f"{prefix}_robust", f"{name} rob.", "verdict", meaning="by robust tests"),
            Optional(f"{prefix}_differ", "", meaning="where the two rules disagree"),
        ]
    hold = "indicators that hold, of those that can be judged, by"
    columns += [
        Optional("score_paper", "S", meaning=f"{hold} the paper's rule"),
        Optional("score_robust", "S rob.", meaning=f"{hold} the robust rule"),
        *ceiling_columns("humans I1-I4 (%)", "humans, rob. (%)"),
    ]
    rows = [_group_row(study, group) for group in study.groups]
    return Table("ablation-qualitative", columns, rows, NOTES)


def _group_row(study: StudyResults, group: Group) -> Row:
    judged = score(study, group)
    values: dict[str, Value] = {"n": len(group.ended_outcomes)}
    for name in INDICATORS:
        values |= verdict_values(judged, name, f"{name.lower()}_")
    values |= verdict_values(judged, SCORE, "score_") | ceiling_values(group, judged, SCORE)
    remarks = reasons(judged, *INDICATORS), no_ceiling(group), outcomes_note(group)
    return row_of(group, values, *remarks, rests_on=ENDED)
