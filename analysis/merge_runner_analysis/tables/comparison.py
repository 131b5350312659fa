"""Differences between two groups, measure by measure."""

from __future__ import annotations

from collections.abc import Sequence

from merge_runner_analysis.stats.effects import Effect, driver_effects
from merge_runner_analysis.stats.sides import level_estimate
from merge_runner_analysis.study import StudyResults
from merge_runner_analysis.tables.effect_notes import families, primary_name, uncounted
from merge_runner_analysis.tables.effects import DIFFERENCE, effect_row, is_shown
from merge_runner_analysis.tables.model import Column, Optional, Row, Table, Value

SUFFIXES = ("", "_reference")  # of the columns of a comparison, for its two drivers


def comparison(study: StudyResults, driver: str, reference: str) -> Table:
    """Return the differences of two groups, given by their ids: a row per measure.

    Values are over the cells of both, or over all trials where nothing is compared.
    """
    known = {group.id: group for group in study.models}
    are_judged = {driver, reference} <= {*known}
    differences = driver_effects(study, known[driver], known[reference]) if are_judged else []
    return Table(
        "comparison",
        (
            Column("measure", "measure"),
            *(
                Optional(f"{name}{end}", f"{name} ref." if end else name, "count")
                for end in SUFFIXES
                for name in ("k", "n")
            ),
            *(Optional(f"value{end}", f"value{end}", "number") for end in SUFFIXES),
            *DIFFERENCE,
        ),
        [_compared_row(study, effect) for effect in differences if is_shown(effect)],
        (_correction(study, differences),),
    )


def _correction(study: StudyResults, effects: Sequence[Effect]) -> str:
    """Describe the correction of these effects' p."""
    tested = [effect for effect in effects if effect.difference.p is not None]
    of_primary, others = families(tested)
    alone = f"; {primary_name(study)}, the primary measure, is tested by itself"
    return f"Corrected for {len(others)} tests (Holm){uncounted(tested)}{alone * bool(of_primary)}."


def _compared_row(study: StudyResults, effect: Effect) -> Row:
    """Return the row of a comparison: both sides within shared cells, or over all their trials."""
    values: dict[str, Value] = {}
    sides = (effect.level, effect.at_level), (effect.reference, effect.at_reference)
    for end, (level, estimate) in zip(SUFFIXES, sides, strict=True):
        shown = level_estimate(study, level, effect.metric) if estimate.value is None else estimate
        # For the share of valid replies k counts replies, not trials: it is left out.
        k = shown.k if effect.metric.rate else None
        values |= {f"k{end}": k, f"n{end}": shown.n, f"value{end}": shown.value}
    return effect_row(study, effect, values)
