"""Differences between prompts, driver by driver."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from math import isinf

from merge_runner.study.arms import PROMPT
from merge_runner_analysis.metrics import LEFT_FIRST, shown_in
from merge_runner_analysis.stats.effects import effects
from merge_runner_analysis.stats.levels import DRIVER, copied_of_shared
from merge_runner_analysis.study import StudyResults
from merge_runner_analysis.tables.effect_notes import effect_notes
from merge_runner_analysis.tables.effects import TEST, effect_row
from merge_runner_analysis.tables.model import Column, Optional, Table, Value, interval
from merge_runner_analysis.wording import SAME_TRIALS

NO_PAIR = "there is no pair of judged groups to compare"


def contrasts(study: StudyResults) -> Table:
    """Return the effects of prompts, driver by driver."""
    known = {group.id: group for group in study.models}
    shown = {LEFT_FIRST, *shown_in("tables")}
    rows = []
    for effect in effects(study, DRIVER):
        if effect.across or effect.level.factor != PROMPT or effect.metric not in shown:
            continue
        group, other = (known[level.groups[0]] for level in (effect.level, effect.reference))
        if effect.difference.p is None:
            continue
        freedom = effect.difference.freedom
        values: dict[str, Value] = {
            "driver": group.label,
            "setting": group.setting,
            "reference": other.setting,
            "p_holm": effect.p_corrected,
            "freedom": None if isinf(freedom) else freedom,
        }
        name = f"{group.id}/{other.setting}/{effect.metric.name}"
        rows.append(replace(effect_row(study, effect, values), id=name))
    return Table(
        "contrasts",
        (
            Column("driver", "driver"),
            Column("setting", "prompt"),
            Column("reference", "against"),
            Column("measure", "measure"),
            Column("difference", "difference", "number", "first minus second"),
            interval("ci", "of the same test"),
            Column("p", "p", "p", TEST),
            Column("p_holm", "p, corr.", "p", "corrected by Holm"),
            Optional("detectable", "detectable", "number", "at p < .05 with power .8"),
            Column("n", "n", "count", "trials of the setting in the shared conditions"),
            Column("n_reference", "n ref.", "count", "trials of the reference in these"),
            Optional("freedom", "df", "number", "of a t test", digits=0),
        ),
        rows,
        (
            *_same_as_reference(study),
            *(
                effect_notes(study, DRIVER)
                if rows
                else ["there is no pair of judged groups to compare"]
            ),
        ),
    )


def _same_as_reference(study: StudyResults) -> Iterator[str]:
    """Yield a note on prompts without a row, since programs do not read them."""
    every = [effect for effect in effects(study, DRIVER) if effect.level.factor == PROMPT]
    same = [
        effect.level.groups[0]
        for effect in every
        if copied_of_shared(study, effect.level, effect.reference)[0]
    ]
    if same:
        yield f"{', '.join(dict.fromkeys(same))}, beside {study.reference}: {SAME_TRIALS}"
