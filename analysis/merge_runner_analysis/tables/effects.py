"""Tables of effects: of all factors, of prompts, and between two drivers."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import chain
from math import isinf, tanh
from textwrap import shorten

from merge_runner.study.arms import PROMPT
from merge_runner_analysis.metrics import (
    INTERVALS,
    JUDGED,
    LEFT_FIRST,
    RULES_NOTE,
    Metric,
    shown_in,
)
from merge_runner_analysis.stats.effects import (
    Effect,
    driver_effects,
    effects,
    primary,
    texts_of,
    unreadable,
)
from merge_runner_analysis.stats.estimate import Estimate
from merge_runner_analysis.stats.levels import DRIVER, Level, copied_of_shared, levels_by_factor
from merge_runner_analysis.stats.measures import undecided_note
from merge_runner_analysis.stats.sides import cells_seen, level_estimate, one_sided
from merge_runner_analysis.study import StudyResults
from merge_runner_analysis.tables.model import Column, Optional, Row, Table, Value, interval
from merge_runner_analysis.wording import (
    CORRECTED,
    METRIC_NAMES,
    PLANTED,
    SAME_TRIALS,
    TIMES,
    WORDS,
    joined,
    note_of,
)

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
SIDED = ", and for who goes first one side of the driver under study"
WORDS_SHOWN = 80  # characters of a level's words
GIVEN_TO = {
    "both": "to both drivers",
    "ego": "to the driver under study",
    "other": "to the other driver",
}
SUFFIXES = ("", "_reference")  # of the columns of a comparison, for its two drivers


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
        [_row(study, effect) for effect in effects(study, by) if _is_shown(effect)],
        tuple(_notes(study, by)),
    )


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
            *(Optional(f"{name}{end}", name, "count") for end in SUFFIXES for name in ("k", "n")),
            *(Optional(f"value{end}", f"value{end}", "number") for end in SUFFIXES),
            *DIFFERENCE,
        ),
        [_compared_row(study, effect) for effect in differences if _is_shown(effect)],
        (_correction(study, differences),),
    )


def _correction(study: StudyResults, effects: Sequence[Effect]) -> str:
    """Describe the correction of these effects' p."""
    tested = [effect for effect in effects if effect.difference.p is not None]
    of_primary, others = _families(tested)
    alone = f"; {_primary_name(study)}, the primary measure, is tested by itself"
    return (
        f"Corrected for {len(others)} tests (Holm){_uncounted(tested)}{alone * bool(of_primary)}."
    )


def _uncounted(tested: Sequence[Effect]) -> str:
    is_complete = all(effect.varies for effect in tested)
    return "" if is_complete else ", without those in which nothing varies within a situation"


def _primary_name(study: StudyResults) -> str:
    measure = primary(study)
    return METRIC_NAMES.get(measure.name, measure.heading)


def _compared_row(study: StudyResults, effect: Effect) -> Row:
    """Return the row of a comparison: both sides within shared cells, or over all their trials."""
    values: dict[str, Value] = {}
    sides = (effect.level, effect.at_level), (effect.reference, effect.at_reference)
    for end, (level, estimate) in zip(SUFFIXES, sides, strict=True):
        shown = level_estimate(study, level, effect.metric) if estimate.value is None else estimate
        # For the share of valid replies k counts replies, not trials: it is left out.
        k = shown.k if effect.metric.rate else None
        values |= {f"k{end}": k, f"n{end}": shown.n, f"value{end}": shown.value}
    return _row(study, effect, values)


def _is_shown(effect: Effect) -> bool:
    """Return whether an effect has a row: no median, and no interaction without a test."""
    is_tested = not effect.across or effect.difference.p is not None
    return effect.metric.estimator != "median" and is_tested


def _row(study: StudyResults, effect: Effect, others: dict[str, Value] | None = None) -> Row:
    """Return the row of an effect; ``others`` add to its values or replace them."""
    difference = effect.difference
    level, reference = effect.level.name, effect.reference.name
    if effect.across and not study.selection.by:
        level, reference = (
            f"{crossed.name}{TIMES}{crossed.at.partition('=')[2]}"
            for crossed in (effect.level, effect.across[1])
        )
    values: dict[str, Value] = {
        "at": _place(effect.level, effect.across),
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


def _place(level: Level, across: tuple[Level, Level] | None) -> str:
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


def _notes(study: StudyResults, by: str) -> Iterator[str]:
    tested = [effect for effect in effects(study, by) if effect.difference.p is not None]
    every = levels_by_factor(study)
    if failure := unreadable(study):
        yield failure
    if planted := _planted(study):
        yield f"{PLANTED}: {'; '.join(planted)}"
    yield from _words(study)
    if not tested and not every:
        yield "the trials of judged drivers differ in no factor"
        return
    yield (
        "levels are compared within the cells that both have; a cell is a condition with one level "
        f"of each other factor{SIDED * one_sided(study)}. Shares are compared by the "
        "test of Mantel and Haenszel, with its score interval; means by Welch's test, in a model "
        "with an intercept for each cell. An "
        "interaction (×) is a level's difference from its reference, minus the same difference at "
        "the reference of the other factor, in the cells that all four have"
    )
    if tested:
        corrected = [effect for effect in tested if not (by and effect.across)]
        of_primary, others = _families(corrected)
        first = (
            f"the {len(of_primary)} test{'s' * (len(of_primary) != 1)} of “{_primary_name(study)}”"
        )
        rest = f"the {len(others)} {'other ' * bool(of_primary)}tests of the table effects"
        rest += _uncounted(corrected) + _tests_by_factor(others)
        names = joined([*dict.fromkeys(of_primary)] or [""])
        alone = f"{first} by {names}, and separately for " if of_primary else ""
        yield f"{CORRECTED} {alone}{rest}"
        yield "detectable: found at p < .05, before correction, with power .8"
    counts = [
        f"{level.id}: {level.pooled.repeated} of {len(level.pooled.stored.trials)}"
        for level in chain.from_iterable(every)
        if level.pooled.repeated
    ]
    if counts:
        yield (
            f"{', '.join(counts)} trials went exactly as others of the level, which differ only "
            "in a factor that their drivers do not read. Such trials count once, in one cell"
        )
    yield from (f"{levels[0].factor}{levels[0].mark}: {balance(study, levels)}" for levels in every)
    yield RULES_NOTE


def _families(tested: Sequence[Effect]) -> tuple[list[str], list[Effect]]:
    """Return the factors of the tests of the primary measure, and the other effects."""
    counted = [effect for effect in tested if effect.varies]
    of_primary = [effect.factor for effect in counted if effect.primary]
    return of_primary, [effect for effect in counted if not effect.primary]


def _tests_by_factor(tested: Sequence[Effect]) -> str:
    """Return ``: 6 by hurry and 6 by opponent, in crashes and gap at the merge point``."""
    if not tested:
        return ""
    counts = Counter(
        f"{effect.factor}{' (interaction)' * bool(effect.across)}" for effect in tested
    )
    by_factor = joined([f"{count} by {factor}" for factor, count in counts.items()])
    names = dict.fromkeys(METRIC_NAMES.get(of.metric.name, of.metric.label) for of in tested)
    return f": {by_factor}, in {joined([*names])}"


def _words(study: StudyResults) -> Iterator[str]:
    """Yield the words of each level of a factor with texts, and the drivers that get them."""
    for factor, levels in texts_of(study).items():
        for level, text in levels.items():
            changes = (*text.add, *text.replace.values())
            words = " ".join(filter(None, (block.merge or block.straight for block in changes)))
            shown = shorten(words, WORDS_SHOWN, placeholder=" …")
            parts = [f"“{shown}”"] if words else []
            parts += [f"with block {added.block}" for added in text.add if added.block]
            parts += [f"without block {name}" for name in text.remove]
            yield f"{WORDS}{factor}={level}: {', '.join(parts)}, {GIVEN_TO[text.given_to]}"


def _planted(study: StudyResults) -> list[str]:
    """Return the effects of words that a study plants in the mock models that drove."""
    texts = texts_of(study) if any(group.scripted for group in study.models) else {}
    planted = []
    for factor, levels in texts.items():
        for level, text in levels.items():
            if more := text.emulator.own_first:
                # The logistic function is steepest about 0.
                most = f"at most {100 * tanh(more / 4):+.0f} points in a situation"
                changes = f"changes the log-odds of going first by {more:+g} ({most})"
                planted.append(f"{factor}={level} {changes}")
            if gap_m := text.emulator.gap_m:
                planted.append(f"{factor}={level} adds {gap_m:g} m to the gap that drivers aim at")
    return planted


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
            *_notes(study, by),
        ),
    )


def _level_row(study: StudyResults, name: str, effect: Effect, level: Level) -> Row:
    estimate = Estimate() if effect.across else level_estimate(study, level, effect.metric)
    values: dict[str, Value] = {
        "at": _place(level, effect.across),
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
        rows.append(replace(_row(study, effect, values), id=name))
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
            *(_notes(study, DRIVER) if rows else ["there is no pair of judged groups to compare"]),
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


def balance(study: StudyResults, levels: list[Level]) -> str:
    """Return a sentence on whether all levels of a factor have the same cells.

    For who goes first, the mirrored cells of equal drivers count too.
    """
    cells_of = {level.name: cells_seen(study, level) for level in levels}
    every = set().union(*cells_of.values())
    lacking = [
        f"{name} lacks {len(every) - len(cells)} of {len(every)} cells"
        for name, cells in cells_of.items()
        if len(cells) < len(every)
    ]
    if lacking:
        return f"not balanced, so that values over all trials are confounded: {'; '.join(lacking)}"
    same = f"every level has the same {len(every)} cells"
    played = set.intersection(*({*level.pooled.ended["cell"]} for level in levels))
    if played == every:
        return same
    return (
        f"{same} for who goes first, where trials of equal drivers also count in the mirrored "
        f"cell of the other side; for other measures they share {len(played)}"
    )
