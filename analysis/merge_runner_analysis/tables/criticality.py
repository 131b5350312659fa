"""Surrogate measures of safety."""

from __future__ import annotations

from merge_runner.scenarios.merge.measures import NO_CONFLICT_MPS
from merge_runner_analysis.metrics import shown_in
from merge_runner_analysis.study import StudyResults
from merge_runner_analysis.tables.ablation_quantitative import metric_table
from merge_runner_analysis.tables.model import Table


def criticality(study: StudyResults) -> Table:
    """Return surrogate measures of safety of every group whose traces are known."""
    note = (
        "a conflict is resolved when no vehicle, at its present speed, would meet the other at the "
        "first possible contact, the merge point or the end of the track; vehicles that after the "
        f"merge never close in faster than {NO_CONFLICT_MPS} m/s are in no conflict, and have no "
        "time to collision"
    )
    ended = ", ".join(
        metric.heading for metric in shown_in("criticality") if metric.trials == "ended"
    )
    medians = (
        "medians are of finished trials that have the measure; their number stands before each"
    )
    if ended:
        medians += f". {ended}: of all trials that ended"
    return metric_table("criticality", study.measured, "criticality", medians, note)
