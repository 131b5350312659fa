"""Explanation of a trial: its class, its events in words, and the moments to mark.

To see whether one driver could have avoided a collision, its vehicle is moved and judged by the
scenario's own rules; the other vehicle drives as it drove, and keeps its speed after its last
sample.
"""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from math import ceil
from typing import Any, Literal

from merge_runner.config import ScenarioConfig
from merge_runner.records import SIDES, Side, other_side
from merge_runner.scenarios.merge.collision import collided
from merge_runner.scenarios.merge.geometry import Track
from merge_runner.scenarios.merge.vehicle import advance, net_acceleration
from merge_runner_analysis.wording import capital, number

BRAKING, SPEEDING_UP = -1.0, 1.0
"""The hardest actions, as a plan normalises them."""
# Halved so often, the strongest action is known to 0.01 m/s^2.
BISECTIONS = 8
HOLDS = 0.08
"""Part of the greatest acceleration up to which a driver holds its speed: more brakes or goes."""
# Below it a vehicle keeps its speed.
STEADY_MPS2 = 0.05
# Two clocks agree to this many seconds.
TICK_S = 1e-6


@dataclass(frozen=True, slots=True)
class Course:
    """Both vehicles from the start of control on, in SI units, one value a sample.

    Positions are travelled distances.
    """

    scenario: ScenarioConfig
    track: Track
    times_s: list[float]
    positions_m: dict[Side, list[float]]
    speeds_mps: dict[Side, list[float]]

    @property
    def last(self) -> int:
        """The number of the last sample."""
        return len(self.times_s) - 1

    def driven_mps2(self, side: Side, sample: int) -> float:
        """Return a vehicle's acceleration from a sample, which is not the last one, to the next."""
        (before_mps, after_mps) = self.speeds_mps[side][sample : sample + 2]
        return (after_mps - before_mps) / (self.times_s[sample + 1] - self.times_s[sample])

    def commanded_mps2(self, side: Side, sample: int) -> float:
        """Return what a driver did from a sample to the next: without the vehicle's resistance."""
        speed = self.speeds_mps[side][sample]
        rolling_mps2 = net_acceleration(0.0, speed, self.scenario.resistance)
        return self.driven_mps2(side, sample) - rolling_mps2

    @property
    def acts_mps2(self) -> float:
        """The acceleration beyond which a driver brakes or speeds up."""
        return HOLDS * self.scenario.max_acceleration_mps2

    def braked_at(self, side: Side) -> int | None:
        """Return the first sample from which a driver brakes; a vehicle that rolls only slows."""
        samples = range(self.last)
        return next((i for i in samples if self.commanded_mps2(side, i) < -self.acts_mps2), None)

    def sped_up_at(self, side: Side) -> int | None:
        """Return the first sample from which a vehicle speeds up."""
        samples = range(self.last)
        return next((i for i in samples if self.driven_mps2(side, i) > self.acts_mps2), None)

    def avoided(self, side: Side, action: float, since: int) -> bool:
        """Return whether a side avoids the collision by driving one action from a sample on."""
        scenario, commanded_mps2 = self.scenario, action * self.scenario.max_acceleration_mps2
        own_m, speed = self.positions_m[side][since], self.speeds_mps[side][since]
        for other_m in self._onward(other_side(side), since):
            net_mps2 = net_acceleration(commanded_mps2, speed, scenario.resistance)
            own_m, speed = advance(own_m, speed, net_mps2, scenario.step_s)
            left_m, right_m = (own_m, other_m) if side == "left" else (other_m, own_m)
            if collided(scenario, self.track, left_m, right_m):
                return False
            if max(left_m, right_m) >= self.track.end_m:
                break
        return True

    def last_chance(self, side: Side, action: float, after: int = -1) -> int | None:
        """Return the last sample from which a side's hardest action still avoids the collision.

        An earlier beginning is always better than a later one. Return None if no sample ``after`` a
        given one suffices.
        """
        exit_m = self.track.tunnel_exit_m - TICK_S  # from there on the driver has control
        under_control = (i for i, at_m in enumerate(self.positions_m[side]) if at_m > exit_m)
        low = max(after + 1, next(under_control, self.last))
        if low >= self.last or not self.avoided(side, action, low):
            return None
        later = range(low + 1, self.last)  # in the end they have collided
        return low + bisect_left(later, True, key=lambda i: not self.avoided(side, action, i))

    def least_mps2(self, side: Side, action: float, since: int) -> float:
        """Return the least strength that avoids the collision from a sample on."""
        low, high = 0.0, 1.0
        if self.avoided(side, low, since):
            return low
        for _ in range(BISECTIONS):
            middle = (low + high) / 2
            enough = self.avoided(side, action * middle, since)
            low, high = (low, middle) if enough else (middle, high)
        return high * self.scenario.max_acceleration_mps2

    def _onward(self, side: Side, since: int) -> Iterator[float]:
        """Yield a vehicle's positions after a sample, until a trial would be timed out."""
        positions, speed = self.positions_m[side], self.speeds_mps[side][-1]
        yield from positions[since + 1 :]
        position = positions[-1]
        for _ in range(self.last, self.scenario.timeout_steps):
            position, speed = advance(position, speed, 0.0, self.scenario.step_s)
            yield position


NO_VALID_PLAN, ONE_BRAKED, BOTH_BRAKED = "no valid plan", "one braked", "both braked"
# By the number of drivers that sped up.
NOBODY_BRAKED = (
    "nobody braked or sped up",
    "nobody braked, one sped up",
    "nobody braked, both sped up",
)
COLLISIONS = (*NOBODY_BRAKED, ONE_BRAKED, BOTH_BRAKED, NO_VALID_PLAN)
NEAR_MISS, LONG_WAIT = "near miss", "long wait"

NEAR_TTC_S = 1.5
"""Below this time to collision an encounter is commonly called critical: A. R. A. van der Horst, A
time-based analysis of road user behaviour in normal and critical encounters (TU Delft, 1990)."""
NEAR_GAP_M = 1.0
"""A gap that is as good as none: ours. The humans' mean is 3.85 m."""
LONG_WAIT_TIMES = 2.0
"""A wait is long from this multiple of the time at the initial speeds on: ours."""

# Classes of trials without a collision, by their columns and ``alone_s``: the time at which the
# first vehicle would have been at the merge point if both had kept their initial speeds.
OTHER_ACCOUNTS = f"""
CASE WHEN status = 'finished' AND (gap_m < {NEAR_GAP_M} OR min_ttc_s < {NEAR_TTC_S})
    THEN '{NEAR_MISS}'
WHEN status IN ('finished', 'timeout')
    AND coalesce(time_to_merge_s, end_time_s) >= {LONG_WAIT_TIMES} * alone_s THEN '{LONG_WAIT}' END
"""
ALONE = """
SELECT trial_id, spec_hash,
    min((merge_point_m() - position_m) / nullif(velocity_mps, 0)) AS alone_s
FROM states WHERE step = 0 GROUP BY ALL
"""

Decided = Sequence[Mapping[str, Any]]
"""Decisions in the order of their numbers: side, decision, time_s, valid, tactical, fallback."""


def collision_class(course: Course, decisions: Decided) -> str:
    """Return the class of a collision: how many drivers braked, at any time up to it.

    Where nobody did, it says how many sped up. ``no valid plan`` goes before: a driver drove on an
    older plan, or none, when its own braking could last have helped.
    """
    if any(_drove_no_plan_of_its_own(course, decisions, side) for side in SIDES):
        return NO_VALID_PLAN
    braked = sum(course.braked_at(side) is not None for side in SIDES)
    sped_up = sum(course.sped_up_at(side) is not None for side in SIDES)
    return (NOBODY_BRAKED[sped_up], ONE_BRAKED, BOTH_BRAKED)[braked]


def last_escape(course: Course) -> tuple[int, Side | None, float]:
    """Return the last sample from which one driver alone avoids the collision: its side, action.

    If there is none: the last sample, None and 0.
    """
    latest: tuple[int, Side | None, float] = -1, None, 0.0
    for side in SIDES:
        for action in (BRAKING, SPEEDING_UP):
            later = course.last_chance(side, action, latest[0])
            latest = latest if later is None else (later, side, action)
    return latest if latest[1] else (course.last, None, 0.0)


def _drove_no_plan_of_its_own(course: Course, decisions: Decided, side: Side) -> bool:
    made_by_side = [decision for decision in decisions if decision["side"] == side]
    if not any(decision["fallback"] for decision in made_by_side):
        return False
    chance = course.last_chance(side, BRAKING)
    until_s = -1.0 if chance is None else course.times_s[chance] + TICK_S
    made = [decision["fallback"] for decision in made_by_side if decision["time_s"] <= until_s]
    return bool(made and made[-1])


SAYS = {"M": "merge", "Y": "yield"}
HEADINGS = {NEAR_MISS: "Why it came close", LONG_WAIT: "Why it took so long"}
UNPLANNED = "a driver drove without a valid plan when its braking could last have helped"


@dataclass(frozen=True, slots=True)
class Mark:
    """A moment of a trial: what happened, on which side, in a few words."""

    time_s: float
    side: Side
    kind: Literal["choice", "invalid", "last chance"]
    text: str


@dataclass(frozen=True, slots=True)
class Account:
    """Explanation of a trial: a heading, sentences, and marks."""

    heading: str
    sentences: list[str]
    marks: list[Mark]


def account(course: Course, decisions: Decided, trial: Mapping[str, Any]) -> Account:
    """Return the account of a trial of any class: ``trial`` has it and its measures."""
    name = trial["account"]
    chances: dict[Side, int | None] = {}
    if name == NEAR_MISS:
        sentence = f"It came close: the gap was {number(trial['gap_m'])} m at the first merge"
        if trial["min_ttc_s"] is not None:
            sentence += f", then the time to collision fell to {number(trial['min_ttc_s'])} s"
        sentences = [f"{sentence}."]
    elif name == LONG_WAIT:
        took_s = trial["time_to_merge_s"]
        reached = "Nobody had reached the merge point at the end"
        if took_s is not None:
            reached = f"The first vehicle reached the merge point after {number(took_s)} s"
        times = f"{LONG_WAIT_TIMES:g} times as long as at the initial speeds, or longer"
        sentences = [f"{reached}: {times}."]
    else:
        chances = {side: course.last_chance(side, BRAKING) for side in SIDES}
        avoidable = (_avoidable(course, side, chance) for side, chance in chances.items())
        sentences = [_collision(course, name), *avoidable, *_by_speeding_up(course)]
    marks = sorted(_marks(course, decisions, chances), key=lambda mark: mark.time_s)
    return Account(HEADINGS.get(name, "Why it crashed"), sentences, marks)


def _collision(course: Course, name: str) -> str:
    left, right = (_actions(course, side) for side in SIDES)
    return (
        f"{capital(UNPLANNED if name == NO_VALID_PLAN else name)}: the left driver {left}, the "
        f"right one {right}. Accelerations beyond {course.acts_mps2:g} m/s² count."
    )


def _actions(course: Course, side: Side) -> str:
    braked, sped_up = course.braked_at(side), course.sped_up_at(side)
    if braked is None:
        return "neither braked nor sped up" if sped_up is None else "sped up and never braked"
    before = "sped up, and " if sped_up is not None and sped_up < braked else ""
    return f"{before}first braked at {course.times_s[braked]:.1f} s"


def _avoidable(course: Course, side: Side, chance: int | None) -> str:
    """Return a driver's last moment to avoid the collision by braking, and the braking needed."""
    if chance is None:
        return f"By braking alone the {side} driver could never have avoided it."
    done, _ = _braking(course, side, chance)
    return (
        f"Until {course.times_s[chance]:.1f} s the {side} driver could have avoided it by {done} "
        "from then on."
    )


def _by_speeding_up(course: Course) -> Iterator[str]:
    """Yield who could have avoided it by speeding up, if later than anybody by braking."""
    at, side, action = last_escape(course)
    if action == SPEEDING_UP:
        until = f"Until {course.times_s[at]:.1f} s the {side} driver could have avoided it by"
        yield f"{until} speeding up as hard as it could."


def _braking(course: Course, side: Side, chance: int) -> tuple[str, str]:
    """Return the braking that avoids the collision from a sample on, compared with the driven.

    Two texts: for a sentence, rounded up, and for a mark.
    """
    least_mps2 = ceil(course.least_mps2(side, BRAKING, chance) * 10 - TICK_S) / 10
    braked_mps2 = -course.commanded_mps2(side, chance)
    if not least_mps2:
        if course.driven_mps2(side, chance) >= STEADY_MPS2:
            return "not speeding up any further", "last moment to stop speeding up"
        if course.scenario.resistance != "none":
            return "letting the vehicle roll", "last moment to let the vehicle roll"
        return "keeping the speed that it had", "last moment to keep its speed"
    if braked_mps2 < STEADY_MPS2:
        return f"braking at {least_mps2:.1f} m/s²", "last moment to brake"
    if braked_mps2 >= least_mps2:
        return f"braking on at {least_mps2:.1f} m/s²", "last moment to brake on"
    harder = f"braking at {least_mps2:.1f} m/s² in place of {braked_mps2:.1f}"
    return harder, "last moment to brake harder"


def _marks(
    course: Course, decisions: Decided, chances: Mapping[Side, int | None]
) -> Iterator[Mark]:
    """Yield each choice that differs from the one before, each fallback and each last chance."""
    before: dict[Side, str] = {}
    for decision in decisions:
        at_s, side, word = decision["time_s"], decision["side"], decision["tactical"]
        if word and word != before.get(side):
            before[side] = word
            yield Mark(at_s, side, "choice", f"chooses to {SAYS[word]}")
        if decision["fallback"]:
            yield Mark(at_s, side, "invalid", "no valid plan")
    for side, chance in chances.items():
        if chance is not None:
            _, text = _braking(course, side, chance)
            yield Mark(course.times_s[chance], side, "last chance", text)
    until, escaping, action = last_escape(course) if chances else (0, None, 0.0)
    if escaping and action == SPEEDING_UP:
        yield Mark(course.times_s[until], escaping, "last chance", "last moment to speed up")
