"""A trial's account in words, with the moments that charts mark."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from math import ceil
from typing import Any, Literal

from merge_runner.records import SIDES, Side
from merge_runner_analysis.accounts.classes import (
    ACTED_MPS,
    BOTH_GAVE_WAY,
    BOTH_INSISTED,
    INVALID_PLAN,
    LONG_WAIT,
    NEAR_MISS,
    NO_ACTION,
    ONE_TOO_LITTLE,
    Decided,
    judged_at,
)
from merge_runner_analysis.accounts.course import BRAKING, SPEEDING_UP, TICK_S, Course

SAYS = {"M": "merge", "Y": "yield"}
# What a tenth of 1 m/s does not show.
UNSEEN = 0.05
HEADINGS = {NEAR_MISS: "Why it came close", LONG_WAIT: "Why it took so long"}
MEANINGS = {
    BOTH_INSISTED: "Both insisted: both had sped up",
    BOTH_GAVE_WAY: "Both gave way: both had slowed down",
    ONE_TOO_LITTLE: "One did too little: the two did different things, which was not enough",
    NO_ACTION: "Neither acted",
    INVALID_PLAN: "A driver drove without a valid plan when its braking could last have helped",
}


@dataclass(frozen=True, slots=True)
class Mark:
    """A moment of a trial: what happened, on which side, in a few words."""

    time_s: float
    side: Side
    kind: Literal["choice", "invalid", "last chance"]
    text: str


@dataclass(frozen=True, slots=True)
class Account:
    """What is to be said of a trial of a class."""

    heading: str
    sentences: list[str]
    marks: list[Mark]


def account(course: Course, decisions: Decided, trial: Mapping[str, Any]) -> Account:
    """Return the account of a trial of any class: ``trial`` has it and its measures."""
    name = trial["account"]
    chances: dict[Side, int | None] = {}
    if name == NEAR_MISS:
        sentences = [_near_miss(trial)]
    elif name == LONG_WAIT:
        sentences = [_long_wait(course, trial)]
    else:
        chances = {side: course.last_chance(side, BRAKING) for side in SIDES}
        avoidable = (_avoidable(course, side, chance) for side, chance in chances.items())
        sentences = [_collision(course, name), *avoidable]
    marks = sorted(_marks(course, decisions, chances), key=lambda mark: mark.time_s)
    return Account(HEADINGS.get(name, "Why it collided"), sentences, marks)


def _near_miss(trial: Mapping[str, Any]) -> str:
    gap_m, ttc_s = trial["gap_m"], trial["min_ttc_s"]
    later = "" if ttc_s is None else f", and afterwards the time to collision fell to {ttc_s:.1f} s"
    return (
        f"It came close: the gap was {gap_m:.1f} m when the first vehicle reached the merge point"
        f"{later}."
    )


def _long_wait(course: Course, trial: Mapping[str, Any]) -> str:
    alone_s, took_s = min(course.arrival_s(side) for side in SIDES), trial["time_to_merge_s"]
    reached = "Nobody had reached the merge point at the end"
    if took_s is not None:
        reached = f"The first vehicle reached the merge point after {took_s:.1f} s"
    return f"{reached}; at the initial speeds it would have been there after {alone_s:.1f} s."


def _collision(course: Course, name: str) -> str:
    at = judged_at(course)
    changes = (course.change_mps(side, at) for side in SIDES)
    left, right = (f"{abs(mps):.1f} m/s {'faster' if mps >= 0 else 'slower'}" for mps in changes)
    when = f"{_clock(course, at)}, when one driver alone could last have avoided it"
    if at == course.last:
        when = "the end; nobody alone could have avoided it"
    return (
        f"{MEANINGS[name]}. At {when}, the left vehicle was {left} and the right one {right} than "
        f"at the start; {ACTED_MPS:g} m/s or more count as acting."
    )


def _avoidable(course: Course, side: Side, chance: int | None) -> str:
    """Until when a driver could have avoided the collision, by how much, and what it did."""
    if chance is not None:
        return (
            f"The {side} driver could still have avoided it at {_clock(course, chance)}, by "
            f"{_effort(course, side, BRAKING, chance)} from then on. Instead it "
            f"{_done(course, side, chance)}."
        )
    never = f"By braking alone the {side} driver could never have avoided it"
    chance = course.last_chance(side, SPEEDING_UP)
    if chance is None:
        return f"{never}."
    effort = _effort(course, side, SPEEDING_UP, chance)
    return f"{never}; it could at {_clock(course, chance)}, by {effort} from then on."


def _effort(course: Course, side: Side, action: float, since: int) -> str:
    """The least that avoids the collision from a sample on, its strength rounded up."""
    mps2 = course.least_mps2(side, action, since)
    if mps2 == 0:
        return "keeping its speed" if course.scenario.resistance == "none" else "rolling on"
    done = "braking" if action == BRAKING else "speeding up"
    return f"{done} at {ceil(mps2 * 10 - TICK_S) / 10:.1f} m/s²"


def _done(course: Course, side: Side, since: int) -> str:
    """What a vehicle did on average from a sample to the end."""
    lasted_s = course.times_s[-1] - course.times_s[since]
    mean_mps2 = (course.speeds_mps[side][-1] - course.speeds_mps[side][since]) / lasted_s
    if abs(mean_mps2) < UNSEEN:
        return "kept its speed"
    return f"{'sped up' if mean_mps2 > 0 else 'braked'} by {abs(mean_mps2):.1f} m/s² on average"


def _marks(
    course: Course, decisions: Decided, chances: Mapping[Side, int | None]
) -> Iterator[Mark]:
    """Each choice that differs from the one before, each fallback, and each last chance."""
    for side in SIDES:
        before = None
        for decision in decisions:
            word = decision["tactical"]
            if decision["side"] == side and word and word != before:
                yield Mark(decision["time_s"], side, "choice", f"chooses to {SAYS[word]}")
                before = word
    for decision in decisions:
        if decision["fallback"]:
            yield Mark(decision["time_s"], decision["side"], "invalid", "no valid plan")
    for side, chance in chances.items():
        if chance is not None:
            yield Mark(course.times_s[chance], side, "last chance", "last moment to brake")


def _clock(course: Course, sample: int) -> str:
    return f"{course.times_s[sample]:.1f} s"
