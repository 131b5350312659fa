"""A trial's account in words, with the moments that charts mark."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from math import ceil, isinf
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
    driven_at,
    judged_at,
)
from merge_runner_analysis.accounts.course import BRAKING, SPEEDING_UP, TICK_S, Course

SAYS = {"M": "merge", "Y": "yield"}
# Of a driver that changes its mind more often, only the last word is told.
CHANGES_TOLD = 4
# Predictions are told a second apart at least.
APART_S = 1.0
# What a tenth of a second or of 1 m/s does not show.
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
class Prediction:
    """When each vehicle would be at the merge point at the speed that it had then; inf: never."""

    time_s: float
    left_s: float
    right_s: float

    @property
    def arrivals(self) -> list[str]:
        """Both times in words, the left one's first."""
        return ["never" if isinf(at_s) else f"{at_s:.1f}" for at_s in (self.left_s, self.right_s)]

    @property
    def first(self) -> str:
        """Who would be first, and by how much."""
        if isinf(self.left_s) and isinf(self.right_s):
            return "nobody"
        ahead_s = abs(self.left_s - self.right_s)
        if ahead_s < UNSEEN:
            return "both together"
        side = "left" if self.left_s < self.right_s else "right"
        return side if isinf(ahead_s) else f"{side}, by {ahead_s:.1f} s"


@dataclass(frozen=True, slots=True)
class Account:
    """What is to be said of a trial of a class."""

    heading: str
    sentences: list[str]
    predictions: list[Prediction]
    marks: list[Mark]


def account(course: Course, decisions: Decided, trial: Mapping[str, Any]) -> Account:
    """The account of a trial of any class: ``trial`` has it and its measures."""
    name = trial["account"]
    chances: dict[Side, int | None] = {}
    if name == NEAR_MISS:
        said = _near_miss(trial)
    elif name == LONG_WAIT:
        said = _long_wait(course, trial)
    else:
        said = _collision(course, name)
        chances = {side: course.last_chance(side, BRAKING) for side in SIDES}
    return Account(
        HEADINGS.get(name, "Why it collided"),
        [
            said,
            *_choices(decisions),
            *(_braking(course, decisions, side, chance) for side, chance in chances.items()),
        ],
        list(_predictions(course, decisions)),
        sorted(_marks(course, decisions, chances), key=lambda mark: mark.time_s),
    )


def changes_of_mind(decisions: Decided, side: Side) -> list[tuple[float, str]]:
    """When a driver chose M or Y, and when it chose otherwise than before: (time in s, word)."""
    found: list[tuple[float, str]] = []
    for decision in decisions:
        word = decision["tactical"]
        if decision["side"] == side and word and (not found or found[-1][1] != word):
            found.append((decision["time_s"], word))
    return found


def _collision(course: Course, name: str) -> str:
    at = judged_at(course)
    left, right = (_change(course.change_mps(side, at)) for side in SIDES)
    when = (
        "the end; nobody alone could have avoided it"
        if at == course.last
        else f"{_clock(course, at)}, when one driver alone could last have avoided it"
    )
    return (
        f"{MEANINGS[name]}. At {when}, the left vehicle was {left} and the right one {right} "
        f"than at the start; {ACTED_MPS:g} m/s or more count as acting."
    )


def _change(change_mps: float) -> str:
    return f"{abs(change_mps):.1f} m/s {'faster' if change_mps >= 0 else 'slower'}"


def _near_miss(trial: Mapping[str, Any]) -> str:
    gap_m, ttc_s = trial["gap_m"], trial["min_ttc_s"]
    gap = f"the gap was {gap_m:.1f} m when the first vehicle reached the merge point"
    if ttc_s is None:
        return f"It came close: {gap}."
    return f"It came close: {gap}, and afterwards the time to collision fell to {ttc_s:.1f} s."


def _long_wait(course: Course, trial: Mapping[str, Any]) -> str:
    alone, took = min(course.arrival_s(side, 0) for side in SIDES), trial["time_to_merge_s"]
    left, right = (_slowest(course, side) for side in SIDES)
    reached = (
        "Nobody had reached the merge point at the end"
        if took is None
        else f"The first vehicle reached the merge point after {took:.1f} s"
    )
    return (
        f"{reached}; at the initial speeds it would have been there after {alone:.1f} s. "
        f"The left vehicle was slowest {left}, the right one {right}."
    )


def _slowest(course: Course, side: Side) -> str:
    speeds = course.speeds_mps[side]
    return f"at {_clock(course, speeds.index(min(speeds)))}, with {min(speeds):.1f} m/s"


def _choices(decisions: Decided) -> Iterator[str]:
    for side in SIDES:
        found = changes_of_mind(decisions, side)
        if not found:
            continue
        (first_s, first), (last_s, last) = found[0], found[-1]
        begun = f"The {side} driver chose to {SAYS[first]} at {first_s:.1f} s"
        if len(found) == 1:
            yield f"{begun} and never changed its mind."
        elif len(found) <= CHANGES_TOLD:
            others = ", ".join(f"{SAYS[word]} at {at_s:.1f} s" for at_s, word in found[1:])
            yield f"{begun} and changed its mind: {others}."
        else:
            yield (
                f"{begun} and changed its mind {len(found) - 1} times, the last time at "
                f"{last_s:.1f} s, to {SAYS[last]}."
            )


def _predictions(course: Course, decisions: Decided) -> Iterator[Prediction]:
    """Who would have been first, at the speeds of each decision, until one of them was."""
    told_s = -APART_S
    for time_s in sorted({d["time_s"] for d in decisions} or set(course.times_s)):
        at = course.at(time_s)
        past = max(course.positions_m[side][at] for side in SIDES) >= course.track.merge_point_m
        if past or at == course.last:
            break
        if time_s >= told_s + APART_S - TICK_S:
            yield Prediction(time_s, *(course.arrival_s(side, at) for side in SIDES))
            told_s = time_s


def _braking(course: Course, decisions: Decided, side: Side, chance: int | None) -> str:
    if chance is None:
        return f"By braking alone the {side} driver could never have avoided it" + (
            _speeding_up(course, side)
        )
    early = f", or from the start on by {_effort(course, side, BRAKING, 0)}" if chance else ""
    return (
        f"The {side} driver could still have avoided it at {_clock(course, chance)}, by "
        f"{_effort(course, side, BRAKING, chance)} from then on{early}. Instead it "
        f"{_done(course, side, chance)}{_plan(decisions, side, course.times_s[chance])}."
    )


def _speeding_up(course: Course, side: Side) -> str:
    chance = course.last_chance(side, SPEEDING_UP)
    if chance is None:
        return "."
    effort = _effort(course, side, SPEEDING_UP, chance)
    return f"; it could at {_clock(course, chance)}, by {effort} from then on."


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
    done = "sped up" if mean_mps2 > 0 else "braked"
    return f"{done} by {abs(mean_mps2):.1f} m/s² on average"


def _plan(decisions: Decided, side: Side, time_s: float) -> str:
    """By what plan a vehicle was driven at a time; empty where nothing is known of decisions."""
    decision = driven_at(decisions, side, time_s)
    if decision is None:
        return ""
    number = decision["decision"]
    if not decision["fallback"]:
        return f", by the plan of decision {number}"
    valid = [
        d["decision"]
        for d in decisions
        if d["side"] == side and d["valid"] and d["decision"] < number
    ]
    why = f"since decision {number} held no valid one ({decision['failure']})"
    if not valid:
        return f", without any plan, {why}"
    return f", by the older plan of decision {valid[-1]}, {why}"


def _marks(
    course: Course, decisions: Decided, chances: Mapping[Side, int | None]
) -> Iterator[Mark]:
    for side in SIDES:
        for time_s, word in changes_of_mind(decisions, side):
            yield Mark(time_s, side, "choice", f"chooses to {SAYS[word]}")
    for decision in decisions:
        if decision["fallback"]:
            yield Mark(decision["time_s"], decision["side"], "invalid", "no valid plan")
    for side, chance in chances.items():
        if chance is not None:
            yield Mark(course.times_s[chance], side, "last chance", "last moment to brake")


def _clock(course: Course, sample: int) -> str:
    return f"{course.times_s[sample]:.1f} s"
