"""Every measure at each level of each factor, and the difference from the reference."""

from __future__ import annotations

from dataclasses import replace

from merge_runner_analysis.metrics import INTERVALS
from merge_runner_analysis.stats.effects import Effect, effects
from merge_runner_analysis.stats.estimate import Estimate
from merge_runner_analysis.stats.levels import Level
from merge_runner_analysis.stats.measures import undecided_note
from merge_runner_analysis.stats.sides import level_estimate
from merge_runner_analysis.study import StudyResults
from merge_runner_analysis.tables.effect_notes import effect_notes
from merge_runner_analysis.tables.effects import TEST, place_of, problem
from merge_runner_analysis.tables.model import Column, Optional, Row, Table, Value, interval
from merge_runner_analysis.wording import note_of


def factors(study: StudyResults) -> Table:
    """Return the effects with a row for every level, also the references."""
    by = study.selection.by or ""
    rows: dict[str, Row] = {}
    for effect in effects(study, by):
        if not effect.across:
            name = f"{effect.reference.id}/{effect.metric.name}"
            rows.setdefault(name, _level_row(study, name, effect, effect.reference))
        if by or not effect.across:
            row = _level_row(study, effect.id, effect, effect.level)
            difference = {
                "difference": effect.difference.value,
                "difference_ci": effect.difference.bounds(),
                "p": effect.difference.p,
                "p_holm": effect.p_corrected,
            }
            values = {**row.values, **difference}
            rows[effect.id] = replace(row, values=values, note=problem(study, effect))
    return Table(
        "factors",
        (
            *([Column("at", by)] if by else []),
            Column("factor", "factor"),
            Optional("drivers", "drivers"),
            Column("measure", "measure"),
            Column("level", "level"),
            Column("trials", "trials", "count", "trials of the level that ended"),
            Column("n", "n", "count", "of these, trials that count for the measure"),
            Optional("value", "value", "number", "the measure"),
            interval("ci", "of the measure"),
            Optional("difference", "difference", "number", "from the factor's reference"),
            interval("difference_ci", "of the difference"),
            Optional("p", "p", "p", TEST),
            Optional("p_holm", "p, corr.", "p", "corrected by Holm"),
        ),
        [*rows.values()],
        (
            f"intervals: {INTERVALS}. The reference is the level that stands first",
            *effect_notes(study, by),
        ),
    )


def _level_row(study: StudyResults, name: str, effect: Effect, level: Level) -> Row:
    estimate = Estimate() if effect.across else level_estimate(study, level, effect.metric)
    values: dict[str, Value] = {
        "at": place_of(level, effect.across),
        "factor": effect.factor,
        "drivers": "scripted" if level.posing else None,
        "measure": effect.metric.heading,
        "level": level.name,
        "trials": len(level.pooled.ended),
        "n": effect.at_level.n if effect.across else estimate.n,
        "value": estimate.value,
        "ci": estimate.bounds(),
    }
    note = note_of(undecided_note(level.pooled, effect.metric))
    return Row(name, level.groups, values, note, effect.metric.column, copies=level.copies)
