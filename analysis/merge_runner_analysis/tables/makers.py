"""The functions that make the tables, each in the module of its name."""

from __future__ import annotations

from collections.abc import Callable

from merge_runner_analysis.study import StudyResults
from merge_runner_analysis.tables.ablation_qualitative import ablation_qualitative
from merge_runner_analysis.tables.ablation_quantitative import ablation_quantitative
from merge_runner_analysis.tables.attempts import attempts
from merge_runner_analysis.tables.contrasts import contrasts
from merge_runner_analysis.tables.criticality import criticality
from merge_runner_analysis.tables.effects import effects_table
from merge_runner_analysis.tables.factors import factors
from merge_runner_analysis.tables.first_action import first_action
from merge_runner_analysis.tables.gap import gap
from merge_runner_analysis.tables.indicators import indicators
from merge_runner_analysis.tables.levels import levels
from merge_runner_analysis.tables.model import Table
from merge_runner_analysis.tables.verdicts import verdicts
from merge_runner_analysis.tables.who_first import who_first

MAKERS: dict[str, Callable[[StudyResults], Table]] = {
    "verdicts": verdicts,
    "who-first": who_first,
    "gap": gap,
    "indicators": indicators,
    "ablation-qualitative": ablation_qualitative,
    "ablation-quantitative": ablation_quantitative,
    "effects": effects_table,
    "levels": levels,
    "contrasts": contrasts,
    "factors": factors,
    "criticality": criticality,
    "attempts": attempts,
    "first-action": first_action,
}
