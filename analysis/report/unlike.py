"""In plain words: in what a driver differs from the humans, and what could not have been shown."""

from __future__ import annotations

from collections.abc import Iterator

from analysis.data.study import Group, Study
from analysis.report.ablated import SLOPES
from analysis.stats.contrasts import corrected
from analysis.stats.indicators import ALPHA
from analysis.stats.intervals import POWER
from analysis.stats.joint import GAP, NARROW, WHO_FIRST, Difference, differences
from analysis.tables.notes import listed

LEVELS = {
    WHO_FIRST: ("who merges first where nobody is ahead or faster", "logits"),
    GAP: ("the gap where nobody is ahead or faster", "m"),
}


def unlike(study: Study, group: Group) -> Iterator[str]:
    """What one model of a driver and the humans shows of their difference."""
    found = differences(study.human, group)
    tested = [one for one in found if one.p is not None]
    for problem in dict.fromkeys(one.problem for one in found if one.problem):
        yield f"{group.driver}: a difference from the humans cannot be tested: {problem}."
    for remark in dict.fromkeys(one.remark for one in tested if NARROW in one.remark):
        yield f"{group.driver} beside the humans: {remark}."
    holm, _ = corrected([one.p for one in tested if one.p is not None]) if tested else ((), ())
    shown = [one for one, p in zip(tested, holm, strict=True) if p < ALPHA]
    if shown:
        yield (
            f"{group.driver} differs from the humans, in one model of both and after Holm's "
            f"correction for {len(tested)} tests, in {listed([_size(one) for one in shown])}."
        )
    others = [one for one in tested if one not in shown]
    if others:
        yield (
            f"{group.driver}: no difference from the humans is shown in "
            f"{listed([_name(one)[0] for one in others])}. That does not show that there is none: "
            f"the smallest that one such test, not yet corrected, finds with a chance of "
            f"{100 * POWER:.0f} % is {listed([_smallest(one) for one in others])}."
        )


def _name(one: Difference) -> tuple[str, str]:
    return LEVELS[one.outcome] if one.term == "intercept" else SLOPES[one.term]


def _size(one: Difference) -> str:
    name, unit = _name(one)
    return f"{name} by {one.b:+.2f} {unit} (95 % CI {one.low:+.2f} to {one.high:+.2f})"


def _smallest(one: Difference) -> str:
    name, unit = _name(one)
    return f"{one.detectable:.2f} {unit} in {name}"
