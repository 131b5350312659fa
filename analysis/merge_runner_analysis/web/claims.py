"""The claim of a study with factors, in sentences: the surest primary test, and what else changed.

No sentence claims a direction that a corrected p does not carry.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence

from merge_runner.prompts.blocks import title_of
from merge_runner.study.arms import MODEL, OPPONENT, PROMPT, SELF
from merge_runner_analysis.metrics import COLLISIONS, GAP, LEFT_FIRST, RMSE
from merge_runner_analysis.tables.model import Row
from merge_runner_analysis.web.effect_rows import (
    Measured,
    estimate_text,
    is_copied,
    is_tested,
    measured,
)
from merge_runner_analysis.wording import (
    CHANGED,
    EGO,
    ENOUGH,
    FEW,
    METRIC_NAMES,
    SAME_TRIALS,
    capital,
    joined,
)

# Reason for equal trials at both levels with a mock model.
UNREAD = "not tested: the mock model does not read it"
SEEN = (COLLISIONS.name, GAP.name, RMSE.name)  # the most visible measures, in this order


def answered(rows: Sequence[Row], driver: str = EGO[0], planted: str = "") -> tuple[str, str]:
    """Return the answer in a sentence, and the rest; empty where no primary test was made.

    The ``driver`` is the one whose going first is counted, and ``planted`` names planted effects.
    The claim is the surest of the primary tests whose corrected p is below 5 %; where there is
    none it says so, and the rest what could have been seen. It is of mock models only where there
    is no other driver, and then says so.
    """
    # Where models alone vary, their comparison answers.
    asked = [row for row in rows if not (row.values["factor"] == MODEL and row.values["primary"])]
    effects = [*map(measured, asked)]
    unscripted = [row for row in effects if not row.values.get("drivers")]
    rehearsed = "" if unscripted else "In a rehearsal with a mock model, "
    effects = unscripted or effects
    primary = sorted(
        (row for row in effects if is_tested(row) and row.values.get("primary")),
        key=lambda row: row.values["p"],
    )
    why = UNREAD if rehearsed else SAME_TRIALS
    copied = [f"{row.level} is {why}" for row in effects if is_copied(row)]
    if not primary:
        return capital(rehearsed + f"{'; '.join(copied)}.") if copied else "", ""
    if few := _too_few(primary):
        return capital(rehearsed + few), ""
    sure = [row for row in primary if row.is_shown]
    what = changed(primary[0])
    claim = f"no change of {what} is shown by {joined(factors_named(primary))}."
    if sure:
        claim = f"{sure[0].values['factor']} changes {what}: {_both(sure[0], driver)}."
    least = "" if sure else sizes(primary)
    rest = [
        *_of_primary(sure, [row for row in primary if row not in sure]),
        *(f"{capital(text)}." for text in copied),
        f"The study had 80 % power for an effect of {least}." if least else "",
        *_of_others(effects, primary, driver),
        f"{capital(planted)}." if rehearsed and planted else "",
    ]
    return capital(rehearsed + claim), " ".join(filter(None, rest))


def _too_few(primary: Sequence[Measured]) -> str:
    few = [row for row in primary if min(row.values["n"], row.values["n_reference"]) < ENOUGH]
    if not few:
        return ""
    counts = [row.values[name] for row in few for name in ("n", "n_reference")]
    trials = " to ".join(dict.fromkeys(map(str, (min(counts), max(counts)))))
    asked = f"whether {joined(factors_named(few))} changes {changed(primary[0])}"
    return f"too few trials to say {asked}: {trials} a level."


def _of_primary(sure: Sequence[Measured], unshown: Sequence[Measured]) -> Iterator[str]:
    """Yield sentences on the primary tests; the first sure one is the claim's."""
    for row in sure[:1]:
        yield f"The difference is {row.test.replace('], ', '] (95 % interval), ')}."
    for row in sure[1:]:
        yield f"{capital(row.level)} changes it, too: {row.test}."
    yield from _not_shown(unshown)


def _of_others(rows: Sequence[Measured], primary: Sequence[Measured], driver: str) -> Iterator[str]:
    """Yield sentences on interactions in the primary measure, and on changes of other measures.

    They are the most visible changes; without a shown primary effect at least one.
    """
    shown = [row for row in rows if row.is_shown and row not in primary]
    for row in shown:
        if row.is_interaction and row.metric == primary[0].metric:
            names = capital(" and ".join(row.factors))
            yield f"{names} interact: {row.test}."
    also = [
        row
        for row in shown
        if not row.is_interaction and row.values["factor"] != MODEL and row.metric in METRIC_NAMES
    ]
    ranks = {metric: rank for rank, metric in enumerate(SEEN)}
    also.sort(key=lambda row: (ranks.get(row.metric, len(SEEN)), row.values["p"]))
    seen = [row for row in also if row.metric in SEEN][:FEW]
    for row in seen or also[: not any(row.is_shown for row in primary)]:
        yield f"{capital(row.values['factor'])} changes {changed(row)}: {_both(row, driver)}."


def _not_shown(rows: Sequence[Measured]) -> Iterator[str]:
    """Yield sentences on primary tests without an effect; of more than FEW the first alone."""
    if len(rows) > FEW:
        yield (
            f"{len(rows)} levels are not shown to change {changed(rows[0])}; "
            f"{rows[0].level} comes nearest: {rows[0].test}."
        )
        return
    for row in rows:
        level, what = capital(row.level), changed(row)
        yield f"{level} is not shown to change {what}: {row.test}."


def sizes(rows: Sequence[Measured]) -> str:
    """Return the detectable effect of each factor, or only the largest of more than FEW factors.

    A factor with several levels has its largest one.
    """
    known = [row for row in rows if row.values.get("detectable") is not None]
    least = {
        name: max(row.values["detectable"] for row in known if row.values["factor"] == name)
        for name in factors_named(known)
    }
    if len(least) > FEW:
        least = {"any factor": max(least.values())}
    if len(least) < 2:
        return known[0].with_unit(*least.values()) if known else ""
    (factor, first), *others = least.items()
    texts = [f"{known[0].amount(size)} ({name})" for name, size in others]
    return ", ".join([f"{known[0].with_unit(first)} ({factor})", *texts])


def factors_named(rows: Iterable[Measured]) -> list[str]:
    """Return the names of the factors of effects, each once."""
    return list(dict.fromkeys(row.values["factor"] for row in rows))


def _both(row: Measured, driver: str) -> str:
    """Return ``in the same situations, the left driver goes first in 63.00 % with hurry=yes``."""
    factor, level, base = (row.values[name] for name in ("factor", "level", "reference"))
    of, reference = (estimate_text(row, name) for name in ("estimate", "estimate_reference"))
    if row.metric == LEFT_FIRST.name:
        return (
            f"in the same situations {driver} goes first in {of} of finished trials with "
            f"{factor}={level} and in {reference} with {factor}={called(factor, base)}"
        )
    return f"{of} with {factor}={level}, {reference} with {factor}={called(factor, base)}"


def called(factor: object, level: object) -> str:
    """Return a level as a page names it: ``self`` is another copy of the same driver."""
    if factor == OPPONENT and level == SELF:
        return f"{SELF} (another copy of the same driver)"
    return title_of(str(level)) if factor == PROMPT else str(level)


def changed(row: Measured) -> str:
    """Return an effect's measure as a claim names it: ``who goes first``."""
    return CHANGED.get(row.metric, row.name)
