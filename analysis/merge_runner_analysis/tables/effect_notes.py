"""Notes of the tables of effects: tests, corrections, words of levels, balance."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from itertools import chain
from math import tanh
from textwrap import shorten

from merge_runner_analysis.metrics import RULES_NOTE
from merge_runner_analysis.stats.effects import Effect, effects
from merge_runner_analysis.stats.levels import Level, levels_by_factor
from merge_runner_analysis.stats.sides import cells_seen, one_sided
from merge_runner_analysis.stats.study_file import primary, texts_of, unreadable
from merge_runner_analysis.study import StudyResults
from merge_runner_analysis.wording import CORRECTED, METRIC_NAMES, PLANTED, WORDS, joined

SIDED = ", and for who goes first one side of the driver under study"
WORDS_SHOWN = 80  # characters of a level's words
GIVEN_TO = {
    "both": "to both drivers",
    "ego": "to the driver under study",
    "other": "to the other driver",
}


def effect_notes(study: StudyResults, by: str) -> Iterator[str]:
    """Yield the notes of a table of effects, at each level of the factor ``by`` if it is given."""
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
        of_primary, others = families(corrected)
        first = (
            f"the {len(of_primary)} test{'s' * (len(of_primary) != 1)} of “{primary_name(study)}”"
        )
        rest = f"the {len(others)} {'other ' * bool(of_primary)}tests of the table effects"
        rest += uncounted(corrected) + _tests_by_factor(others)
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


def families(tested: Sequence[Effect]) -> tuple[list[str], list[Effect]]:
    """Return the factors of the tests of the primary measure, and the other effects."""
    counted = [effect for effect in tested if effect.varies]
    of_primary = [effect.factor for effect in counted if effect.primary]
    return of_primary, [effect for effect in counted if not effect.primary]


def uncounted(tested: Sequence[Effect]) -> str:
    """Return which tests a correction does not count, or nothing."""
    is_complete = all(effect.varies for effect in tested)
    return "" if is_complete else ", without those in which nothing varies within a situation"


def primary_name(study: StudyResults) -> str:
    """Return the name of the study's primary measure in a sentence."""
    measure = primary(study)
    return METRIC_NAMES.get(measure.name, measure.heading)


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
