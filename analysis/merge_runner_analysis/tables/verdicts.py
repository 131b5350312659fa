"""Every driver beside the humans, by every measure: all that headlines, pages and report read."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace
from typing import Any

from merge_runner.config import ScenarioConfig
from merge_runner.drivers.registry import PROGRAMS
from merge_runner.records import SIDES
from merge_runner.scenarios.merge.conditions import HUMAN_CONDITIONS
from merge_runner_analysis.cache import remembered
from merge_runner_analysis.drivers import language_models
from merge_runner_analysis.frames import KEYS
from merge_runner_analysis.grouping import Group
from merge_runner_analysis.headlines import sentences
from merge_runner_analysis.metrics import BOXES
from merge_runner_analysis.published import HUMAN, HUMAN_TRIALS
from merge_runner_analysis.stats.estimate import Estimate
from merge_runner_analysis.stats.human_reference import of_humans
from merge_runner_analysis.stats.levels import distinct
from merge_runner_analysis.stats.verdicts import Comparison, compared
from merge_runner_analysis.study import StudyResults
from merge_runner_analysis.tables.model import (
    COUNTED,
    Column,
    Optional,
    Row,
    Table,
    Value,
    interval,
)
from merge_runner_analysis.wording import (
    HUMANS,
    LANGUAGE_MODEL,
    MEASURES,
    MOCK,
    PLAYED_RULES,
    PROGRAM,
    TABLE,
    VERDICT_RULE,
    has_verdict,
    note_of,
)

VERDICT_COLUMNS = (
    Column("driver", "driver"),
    Column("setting", "prompt"),
    Column("kind", "kind", meaning="language model, program or mock model"),
    Optional("measure", "measure"),
    Optional("n", "n", "count", "trials that the estimate rests on"),
    Optional("k", "k", "count", "trials that crashed by people's rule", BOXES.column),
    Optional("undecided", "undecided", "count", "ended by another rule"),
    Column("estimate", "estimate", "number", "in the unit of the measure"),
    Optional("ci", "CI", "interval", "95 %; with a margin (I4, I5) at the level of the row"),
    Optional("human", "humans", "number", "in the same conditions"),
    interval("human_ci", "of the humans"),
    Optional("difference", "difference", "number", "driver minus humans"),
    Optional("difference_ci", "CI", "interval", "of the difference, at the level of the row"),
    Optional("level", "level", "number", "of the interval that the verdict rests on, in %"),
    Optional("p", "p", "p", "of no difference; with a margin (I4, I5) of being within it"),
    Optional("p_holm", "Holm", "p", "corrected over the measures of the driver"),
    Optional("detectable", "detectable", "number", "smallest difference found with power .8"),
    Optional("state", "verdict", meaning="what is shown"),
    Optional("rule", "rule", meaning="how the verdict is set", noted=True),
    Optional(
        "counted",
        "counted",
        "text",
        "trials that went so, of those that could",
        COUNTED,
        noted=True,
    ),
    Optional("counted_by", "by", meaning="collision rule that was played", noted=True),
    Optional("human_counted", "humans", meaning="the humans' in its conditions", noted=True),
)


def verdicts(study: StudyResults) -> Table:
    """Return every judged driver and prompt by every measure, the humans first."""
    rows = [] if study.human not in study.groups else [*_human_rows(study)]
    for group in (*(group for group in study.models if not group.caution), *study.unjudged):
        rows += _driver_rows(study, group)
    return Table(
        TABLE,
        VERDICT_COLUMNS,
        rows,
        (
            *sentences(rows),
            *(
                f"{measure.name}: {measure.trait}, {measure.unit}; verdict: {measure.rule}"
                for measure in MEASURES.values()
            ),
            f"{VERDICT_RULE}. The interval of a difference has the level of the test that "
            "decides its verdict: column level",
            "collisions: by the rule of the human experiment, outlines that overlap, checked at "
            "20 Hz; Fisher's exact test within conditions, and the melded interval that agrees "
            "with it; without p where trials are undecided. Conditions weigh in the "
            "humans' share as in the driver's trials, and in their mean gap as in its trials with "
            "a gap",
            f"intervals take trials as independent. The {HUMAN_TRIALS} human trials are of nine "
            "pairs who differ, which only the mean gap and imported gaps allow for",
            *(
                f"{group.id}: {len(copies)} of {len(group.trials)} trials equal another one to "
                "the last state, as no driver reads the words that differ: equal trials count once"
                for group in study.models
                if (copies := _copies(study, group))
            ),
            *(
                f"{group.id}: {group.caution}: it is not judged, nor compared with the humans"
                for group in study.baselines
                if group.caution
            ),
        ),
    )


def _kind(group: Group, spec: Mapping[str, Any]) -> str:
    if group.scripted:
        return MOCK
    models = dict(zip(SIDES, (*group.models, *group.models), strict=False))
    return LANGUAGE_MODEL if language_models(models, spec) else PROGRAM


def _driver(group: Group, kind: str) -> dict[str, Value]:
    return {"driver": group.label, "setting": group.setting, "kind": kind}


def _is_from_humans(group: Group, spec: Mapping[str, Any]) -> bool:
    """Return whether a group's driver, of two the first, is a program made from human data."""
    sides = [side for name in SIDES if "program" in (side := spec.get(name) or {})]
    known = {
        side["program"]: PROGRAMS.get(side.get("based_on") or side["program"]) for side in sides
    }
    program = known.get(group.driver.partition("+")[0])
    return program is not None and program.from_humans


def _driver_rows(study: StudyResults, group: Group) -> Iterator[Row]:
    spec = study.frames.specs.get(group.spec_hash, {})
    driver = _driver(group, _kind(group, spec))
    if group.unjudged:
        yield Row(group.id, (group.id,), driver, group.unjudged)
        return
    rule = ScenarioConfig.model_validate(spec.get("scenario", {})).collision_rule
    copies, from_humans = _copies(study, group), _is_from_humans(group, spec)
    comparisons = compared(study, distinct(study, group))
    crashes = next(of.driver for of in comparisons if of.measure.rests_on == BOXES.column)
    for comparison in comparisons:
        row = _compared(group, driver, comparison, PLAYED_RULES[rule])
        # For words alone, so they are no columns; a state needs half of the trials that ended.
        words = {
            "ended": crashes.n + (crashes.undecided or 0),
            "from_humans": "yes" if from_humans else None,
            "equal": group.equal or None,
        }
        values = {**row.values, **words}
        if not has_verdict(values):  # what could have been seen is of no use then
            values["detectable"] = None
        yield replace(row, values=values, copies=copies)


@remembered
def _copies(study: StudyResults, group: Group) -> tuple[tuple[str, str], ...]:
    """Return a mock model's trials that are copies of others, with words that it does not read."""
    once = distinct(study, group).trials
    if len(once) == len(group.trials):
        return ()
    kept, every = (frame[KEYS].itertuples(index=False, name=None) for frame in (once, group.trials))
    return tuple(sorted({*every} - {*kept}))


def _compared(
    group: Group, driver: dict[str, Value], comparison: Comparison, played_rule: str
) -> Row:
    measure, tested = comparison.measure, comparison.tested
    difference = tested if measure.margin is None else Estimate()
    values = driver | {
        "measure": measure.name,
        **_known(comparison.driver),
        "human": comparison.human.value,
        "human_ci": comparison.human.bounds(),
        "difference": difference.value,
        "difference_ci": difference.bounds(),
        "level": None if tested.p is None else 100 * tested.level,
        "p": tested.p,
        "p_holm": tested.p_holm,
        "detectable": tested.detectable,
        "state": comparison.state or None,
        "rule": measure.rule,
    }
    if counts := comparison.counted:
        values["counted"] = f"{counts.k} of {counts.n}"
        values["human_counted"] = f"{counts.human_k} of {counts.human_n}"
        values["counted_by"] = played_rule if measure.rests_on == BOXES.column else None
    note, played = note_of(*comparison.remarks), {*group.trials["condition"]}
    # Only trials in conditions of humans are compared.
    shared = played & {*HUMAN_CONDITIONS}
    conditions = () if played == shared else tuple(sorted(shared))
    row_id = f"{group.id}/{measure.name}"
    return Row(row_id, (group.id,), values, note, measure.rests_on, conditions)


def _human_rows(study: StudyResults) -> Iterator[Row]:
    for name, estimate in of_humans(study).items():
        values = _driver(study.human, HUMANS) | {"measure": name, **_known(estimate)}
        # Published values rest on no trials here.
        published = estimate.source or not study.human.measured
        rests_on = "" if published else MEASURES[name].rests_on
        note = note_of(estimate.problem, estimate.source)
        yield Row(f"{HUMAN}/{name}", (HUMAN,), values, note, rests_on)


def _known(estimate: Estimate) -> dict[str, Value]:
    return {
        "n": estimate.n,
        "k": estimate.k,
        "undecided": estimate.undecided or None,
        "estimate": estimate.value,
        "ci": estimate.bounds(),
    }
