"""Effects of factors: each level against the reference, in every measure."""

from __future__ import annotations

from merge_runner_analysis.metrics import JUDGED, Metric
from merge_runner_analysis.stats.effects import Effect, effects
from merge_runner_analysis.stats.levels import Level, copied_of_shared
from merge_runner_analysis.stats.measures import undecided_note
from merge_runner_analysis.study import StudyResults
from merge_runner_analysis.tables.effect_notes import effect_notes
from merge_runner_analysis.tables.model import Column, Optional, Row, Table, Value, interval
from merge_runner_analysis.wording import SAME_TRIALS, TIMES, note_of

TEST = "of the test of Mantel and Haenszel, or of Welch's"
UNTESTED = (
    "no test: it needs several trials of each level in shared cells, all of one study, all "
    "decided, and none that counts at both levels"
)
DIFFERENCE = (
    Optional("difference", "difference", "number", "the first less the second"),
    interval("ci", "of the same test"),
    Optional("p", "p", "p", TEST),
    Optional("p_corrected", "p, corr.", "p", "corrected by Holm"),
    Optional("detectable", "detectable", "number", "at p < .05 with power .8"),
)


def effects_table(study: StudyResults) -> Table:
    """Return a row per factor, level, and measure, and per interaction of two factors."""
    by = study.selection.by or ""
    return Table(
        "effects",
        (
            *([Column("at", by)] if by else []),
            Column("factor", "factor"),
            Optional("drivers", "drivers", "text", "scripted: mock models"),
            Column("level", "level"),
            Column("reference", "against"),
            Column("measure", "measure"),
            Optional("estimate", "estimate", "number", "of the level, within the shared cells"),
            Optional("estimate_reference", "reference", "number", "of the reference, in the same"),
            *DIFFERENCE,
            Column("n", "n", "count", "trials of the level in the shared cells"),
            Column("n_reference", "n ref.", "count", "trials of the reference in these"),
            Optional("primary", "primary", "text", "the study's own question"),
        ),
        [effect_row(study, effect) for effect in effects(study, by) if is_shown(effect)],
        tuple(effect_notes(study, by)),
    )


def is_shown(effect: Effect) -> bool:
    """Return whether an effect has a row: no median, and no interaction without a test."""
    is_tested = not effect.across or effect.difference.p is not None
    return effect.metric.estimator != "median" and is_tested


def effect_row(study: StudyResults, effect: Effect, others: dict[str, Value] | None = None) -> Row:
    """Return the row of an effect; ``others`` add to its values or replace them."""
    difference = effect.difference
    level, reference = effect.level.name, effect.reference.name
    if effect.across and not study.selection.by:
        level, reference = (
            f"{crossed.name}{TIMES}{crossed.at.partition('=')[2]}"
            for crossed in (effect.level, effect.across[1])
        )
    values: dict[str, Value] = {
        "at": place_of(effect.level, effect.across),
        "factor": effect.factor,
        "drivers": "scripted" if effect.level.posing else None,
        "level": f"{level}{effect.level.mark}",
        "reference": reference,
        "measure": effect.metric.heading,
        "estimate": effect.at_level.value,
        "estimate_reference": effect.at_reference.value,
        "difference": difference.value,
        "ci": difference.bounds(),
        "p": difference.p,
        "p_corrected": effect.p_corrected,
        "detectable": difference.detectable,
        "n": effect.at_level.n,
        "n_reference": effect.at_reference.n,
        "primary": "primary" if effect.primary else None,
    }
    return Row(
        effect.id,
        effect.groups,
        values | (others or {}),
        problem(study, effect),
        effect.metric.column,
        copies=effect.left_out,
        untested=others is None and effect.at_level.value is None and _is_copied(study, effect),
    )


def _is_copied(study: StudyResults, effect: Effect) -> bool:
    """Return whether in all shared cells a level has the trials of another one."""
    copies, shared = copied_of_shared(study, *effect.levels)
    return 0 < copies == shared


def place_of(level: Level, across: tuple[Level, Level] | None) -> str:
    """Return the level of the other factor; for an interaction, its two levels."""
    at = level.at.partition("=")[2]
    return f"{at} - {across[0].at.partition('=')[2]}" if across else at


def problem(study: StudyResults, effect: Effect) -> str:
    """Return why an effect has no test, or which cells its test leaves out."""
    copies, shared = copied_of_shared(study, *effect.levels)
    metric, difference = effect.metric, effect.difference
    remarks = [note_of(undecided_note(level.pooled, metric)) for level in effect.levels]
    lacks = [level.pooled.trials[metric.column].isna().all() for level in effect.levels]
    if not effect.across and any(lacks):
        remarks.append(f"{metric.heading}: a level has no trial with this measure")
    elif _is_copied(study, effect):
        remarks.append(SAME_TRIALS)
    elif difference.value is None:
        remarks.append(f"{metric.heading}: {UNTESTED}")
    elif difference.p is None and not difference.se and metric.estimator != "median":
        remarks.append(f"{metric.heading}: equal in all trials of a cell: nothing to test")
    elif copies:
        remarks.append(
            f"the difference leaves out {copies} of {shared} shared cells, those with the same "
            "trials at both levels"
        )
    elif metric.rate and difference.p is not None and difference.detectable is None:
        remarks.append(f"{metric.heading}: so few trials can show no difference, however large")
    if metric.trials == "ended" and metric.value not in JUDGED:
        remarks += [_left_out(level, metric) for level in effect.levels]
    return note_of(*dict.fromkeys(remarks))


def _left_out(level: Level, metric: Metric) -> str:
    ended = level.pooled.ended
    lacking = int(ended[metric.column].isna().sum())
    if lacking in (0, len(ended)):
        return ""
    return (
        f"{metric.heading}: {lacking} of {len(ended)} ended trials of {level.id} have no value and "
        "are left out"
    )
