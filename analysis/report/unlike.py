"""In plain words: how a driver differs from humans, and what could not have been shown."""

from __future__ import annotations

from collections.abc import Iterator

from merge_runner_analysis.data.study import Group, Study
from merge_runner_analysis.stats.contrasts import corrected
from merge_runner_analysis.stats.indicators import ALPHA
from merge_runner_analysis.stats.intervals import POWER, Difference
from merge_runner_analysis.stats.joint import GAP, NARROW, WHO_FIRST, Interaction, interactions
from merge_runner_analysis.tables.notes import listed

# How a sentence names each coefficient of the regressions, and its unit.
SLOPES = {
    "projected_headway": ("the effect of headway on who merges first", "logits per m"),
    "relative_velocity": ("the effect of relative velocity on who merges first", "logits per m/s"),
    "abs_projected_headway": ("the effect of |headway| on the gap", "m per m"),
    "abs_relative_velocity": ("the effect of |relative velocity| on the gap", "m per m/s"),
    "headway_x_velocity": (
        "the effect of headway times relative velocity on the gap",
        "m per m²/s",
    ),
}
OUTCOMES = {WHO_FIRST: "who merges first", GAP: "the gap"}
# The intercept's interaction, in words: with every term at 0, nobody is ahead or faster.
LEVELS = {
    WHO_FIRST: ("who merges first where nobody is ahead or faster", "logits"),
    GAP: ("the gap where nobody is ahead or faster", "m"),
}


def unlike(study: Study, group: Group) -> Iterator[str]:
    """What a joint model of a driver and the humans shows about their difference."""
    found = interactions(study.human, group)
    tested = [(one, one.found) for one in found if one.found is not None]
    for outcome, problem in dict.fromkeys((one.outcome, one.problem) for one in found):
        if problem:
            yield (
                f"{group.driver}: a difference from the humans in {OUTCOMES[outcome]} cannot be "
                f"estimated: {problem}."
            )
    for remark in dict.fromkeys(one.remark for one, _ in tested if NARROW in one.remark):
        yield f"{group.driver} beside the humans: {remark}."
    # Over both outcomes at once, since the sentence makes one claim about the driver; the table
    # differences leaves its p uncorrected.
    holm, _ = corrected([difference.p for _, difference in tested]) if tested else ((), ())
    shown = [pair for pair, p in zip(tested, holm, strict=True) if p < ALPHA]
    if shown:
        yield (
            f"{group.driver} differs from the humans, in one model of both and after Holm's "
            f"correction for {len(tested)} tests, in {listed([_size(*pair) for pair in shown])}."
        )
    others = [pair for pair in tested if pair not in shown]
    if others:
        yield (
            f"{group.driver}: no difference from the humans is shown, after Holm's correction, "
            f"in {listed([_name(one)[0] for one, _ in others])}. That does not show that there is "
            f"none: the smallest that one such test, not yet corrected, finds with a chance of "
            f"{100 * POWER:.0f} % is {listed([_smallest(*pair) for pair in others])}."
        )


def _name(one: Interaction) -> tuple[str, str]:
    return LEVELS[one.outcome] if one.term == "intercept" else SLOPES[one.term]


def _size(one: Interaction, found: Difference) -> str:
    name, unit = _name(one)
    return f"{name} by {found.value:+.2f} {unit} (95 % CI {found.low:+.2f} to {found.high:+.2f})"


def _smallest(one: Interaction, found: Difference) -> str:
    name, unit = _name(one)
    return f"{found.detectable:.2f} {unit} in {name}"
