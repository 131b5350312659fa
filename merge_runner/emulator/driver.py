"""The mock model's replies: a human-like driver that reads the prompt and replies in free text.

Who goes first is drawn from the human logistic odds, or from those that a request plants
(``planted_effect``), once per trial for both sides. Both hold piecewise constant accelerations that
open a gap. In every third repetition, in one condition, the driver that should yield misjudges: it
keeps level with the other, and they collide.

A second mock model draws its reply to any prompt at random. It rehearses studies whose prompts the
first one cannot read.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from statistics import NormalDist

from merge_runner.chance import draw, draw_between, draw_index
from merge_runner.planted_effect import PlantedEffect
from merge_runner.prompts.state_lines import NOT_SEEN
from merge_runner.records import FAR_BEHIND_M, Slot
from merge_runner.scenarios.merge.conditions import CONDITIONS, HUMAN_CONDITIONS
from merge_runner.scenarios.merge.geometry import TRACK

VEHICLE_LENGTH_M = 4.5
MAX_ACCELERATION_MPS2 = 2.5
HARDEST_BRAKING_MPS2, HARDEST_PUSH_MPS2 = -2.2, 1.4
SHORTEST_S = 1.0
HUMAN = PlantedEffect()
# Every prompt must contain these.
NEEDED = (
    "Your speed: N m/s",
    "Speed of the other car: N m/s",
    "Relative distance (of the other car, ahead of you): N m",
    "exactly N numbers",
)
OPENINGS = (
    "Neither of us has the right of way.",
    "We approach the merge point at nearly the same time.",
    "I compare when each of us arrives at the merge point.",
)
# For the random driver: the most actions of a plan, and its usual lengths.
MOST_ACTIONS, USUAL_LENGTHS = 200, range(1, 31)


@dataclass(frozen=True, slots=True)
class Situation:
    """Situation that a prompt describes, in SI units."""

    own_speed: float
    other_speed: float
    relative_distance: float
    distance_to_merge: float | None
    asks_tactical: bool
    plan_actions: int
    vehicle_length: float
    other_acceleration: float
    """By the last two observed speeds of the other; 0 if the prompt has no history."""
    previous: float | None
    """Next action of the previous plan, normalised."""
    other_seen: bool = True

    @property
    def other_distance_to_merge(self) -> float:
        """The other vehicle's distance to the merge point; negative after it."""
        return (self.distance_to_merge or 0.0) - self.relative_distance

    @property
    def projected_lead_m(self) -> float:
        """Lead of the own vehicle when the first one reaches the merge point, at present speeds."""
        own_s = (self.distance_to_merge or 0.0) / max(self.own_speed, 0.1)
        other_s = max(self.other_distance_to_merge, 0.0) / max(self.other_speed, 0.1)
        return (self.own_speed - self.other_speed) * min(own_s, other_s) - self.relative_distance


def answer(prompt: str, slot: Slot | None, effect: PlantedEffect | None = None) -> str:
    """Return the reply's text for a prompt; without a slot it depends on the prompt alone."""
    situation = read_prompt(prompt)
    if isinstance(situation, str):
        return situation
    sign = -1 if slot is not None and slot.side == "right" else 1
    planted = None if effect is None else effect.before(prompt, sign)
    trial: tuple[object, ...] = ()
    if slot is not None:
        trial = (slot.condition, slot.repetition, slot.sample_set)
        if planted is not None:  # trials with another effect are drawn independently
            trial += (planted.model_dump_json(),)
    goes_first, misjudges = _draw_order(situation, slot, planted or HUMAN, trial)
    if not situation.other_seen:
        action, reason = 0.0, "I do not see the other car, and keep my speed."
    elif situation.distance_to_merge is None:
        action, reason = _on_straight(situation)
    elif situation.other_distance_to_merge <= 0 and goes_first:
        action = 0.0
        reason = "The other car is through already, so I keep my speed and stay behind it."
    elif situation.other_distance_to_merge <= 0:
        action, reason = _on_straight(situation)
    else:
        decision = (prompt,) if slot is None else tuple(slot.as_dict().values())
        opening = OPENINGS[draw_index(len(OPENINGS), "words", *decision)]
        if misjudges:
            action, reason = _catch_up(situation)
        else:
            gap_m = draw_between(1.8, 6.5, "gap", *trial) + (planted or HUMAN).x_gap_m
            share = draw_between(0.1, 0.7, "share", *trial)
            action, reason = _open_gap(situation, gap_m, share, goes_first=goes_first)
            # The driver keeps the level of its previous plan unless the needed one is far from it.
            level = (
                None if situation.previous is None else situation.previous * MAX_ACCELERATION_MPS2
            )
            if level is None or abs(action - level) >= 0.25:
                level = action + draw_between(-0.05, 0.05, "wobble", *decision)
            action = level
        reason = f"{opening} {reason}"
    normalised = round(min(1.0, max(-1.0, action / MAX_ACCELERATION_MPS2)), 2) + 0.0
    plan = ", ".join([f"{normalised:.2f}"] * situation.plan_actions)
    token = ("M\n\n" if goes_first else "Y\n\n") if situation.asks_tactical else ""
    return f"{token}{reason}\n\n```python\n[{plan}]\n```"


def random_answer(prompt: str, slot: Slot | None) -> str:
    """Return M or Y and a plan, both random; without a slot they depend on the prompt alone."""
    drawn_for = (prompt, *(() if slot is None else slot.as_dict().values()))
    token = "M" if draw("word", *drawn_for) < 0.5 else "Y"
    action = f"{round(draw_between(-1, 1, 'action', *drawn_for), 2) + 0.0:.2f}"
    lengths = {int(number) for number in re.findall(r"exactly (\d+) numbers", prompt)}
    if not lengths:
        # The parser takes the list of the right length out of several.
        mentioned = map(int, re.findall(r"(?<![\d.])\d{1,3}(?!\.?\d)", prompt))
        lengths = {*USUAL_LENGTHS, *(n for n in mentioned if 0 < n <= MOST_ACTIONS)}
    plans = "\n".join(f"[{', '.join([action] * length)}]" for length in sorted(lengths))
    return f"{token}\n\nI draw lots and hold what I draw.\n\n```python\n{plans}\n```"


def read_prompt(prompt: str) -> Situation | str:
    """Return the situation that a prompt describes, or a reply that names what is missing."""
    speed = _quantity("Your speed", "m/s", prompt)
    other_speed = _quantity("Speed of the other car", "m/s", prompt)
    relative = _quantity("Relative distance .*?", "m", prompt)
    actions = _number(r"exactly (\d+) numbers", prompt)
    other_seen = not re.search(rf"Speed of the other car(?:: | \| ){NOT_SEEN}", prompt)
    if not other_seen:
        other_speed, relative = speed, -FAR_BEHIND_M
    if speed is None or other_speed is None or relative is None or actions is None:
        needed = zip(NEEDED, (speed, other_speed, relative, actions), strict=True)
        missing = ", ".join(f"`{words}`" for words, number in needed if number is None)
        return (
            "I am the emulator, a scripted driver and no language model, and cannot read this "
            f"prompt: it does not say {missing}, with a number for N. The model `random` answers "
            "any prompt."
        )
    before = _number(r"Observed speeds of the other car .*[\[ ]([^, \]]+)\]$", prompt)
    step_s = _number(r"one value every (\S+) s", prompt)
    return Situation(
        own_speed=speed,
        other_speed=other_speed,
        relative_distance=relative,
        distance_to_merge=_quantity("Your distance to the merge point", "m", prompt),
        asks_tactical="merge first (M) or yield" in prompt,
        plan_actions=int(actions),
        vehicle_length=_quantity("Length of each car", "m", prompt) or VEHICLE_LENGTH_M,
        other_acceleration=(other_speed - before) / step_s
        if before is not None and step_s
        else 0.0,
        previous=_number(r"not been executed yet\): \[([^,\]]+)", prompt),
        other_seen=other_seen,
    )


def _draw_order(
    situation: Situation, slot: Slot | None, effect: PlantedEffect, trial: tuple[object, ...]
) -> tuple[bool, bool]:
    """Return two truth values: this driver goes first, and it does so by a misjudgement.

    In a misjudged trial both drivers go first. Without a slot the projected order decides.
    """
    if slot is None:
        return situation.projected_lead_m > 0, False
    noise = NormalDist().inv_cdf(draw_between(1e-12, 1 - 1e-12, "noise", *trial))
    probability = _probability_left_first(effect, slot.condition, noise)
    goes_first = (slot.side == "left") == (draw("who first", *trial) < probability)
    # In one human condition of every third repetition.
    turn = draw_index(3, "misjudge turn", slot.sample_set)
    names = list(HUMAN_CONDITIONS)
    chosen = draw_index(len(names), "misjudged condition", slot.repetition, slot.sample_set)
    misjudged = slot.repetition % 3 == turn and names[chosen] == slot.condition
    return goes_first or misjudged, misjudged and not goes_first


def _probability_left_first(effect: PlantedEffect, condition: str, noise: float) -> float:
    kinematics = CONDITIONS.get(condition)
    if kinematics is None:  # a study's own condition, which this process may not know
        return 1 / (1 + math.exp(-max(effect.lead, -700.0)))
    intercept, of_headway, of_speed = effect.coefficients
    logit = (
        intercept
        + of_headway * kinematics.projected_headway_m
        + of_speed * kinematics.relative_velocity_mps
        + effect.x_noise * noise
    )
    return 1 / (1 + math.exp(-max(logit, -700.0)))  # exp of more than 709 overflows


def _catch_up(situation: Situation) -> tuple[float, str]:
    """Return the acceleration of a driver that misjudges, and its reason."""
    catch_up = _even_acceleration(
        -situation.projected_lead_m, situation.distance_to_merge, situation.own_speed
    )
    return min(MAX_ACCELERATION_MPS2, max(0.0, situation.other_acceleration + catch_up)), (
        "I take the gap: with enough speed I reach the merge point before the "
        "other car, which should let me in. I keep an eye on it."
    )


def _open_gap(
    situation: Situation, gap_m: float, share: float, *, goes_first: bool
) -> tuple[float, str]:
    """Return the acceleration that opens a gap before the merge point, and its reason.

    ``share`` is the leader's part of the distance that is missing.
    """
    lead = situation.projected_lead_m if goes_first else -situation.projected_lead_m
    # Below a lead of one metre, what lacks to it is added, so that the leader acts at once.
    missing_m = gap_m + situation.vehicle_length - lead + max(0.0, 1.0 - lead)
    if goes_first:
        push = _even_acceleration(
            share * missing_m, situation.distance_to_merge, situation.own_speed
        )
        return min(HARDEST_PUSH_MPS2, max(0.0, push)), (
            f"At present speeds I would be {lead:.1f} m ahead at the merge point. I go first and "
            "make the gap clear by my speed, and hold this acceleration."
        )
    yielded_m = (1 - share) * missing_m
    brake = -_even_acceleration(yielded_m, situation.other_distance_to_merge, situation.other_speed)
    return min(0.0, max(HARDEST_BRAKING_MPS2, brake)), (
        f"The other car will be about {lead:.1f} m ahead at the merge point if nobody acts. I "
        "let it go first and slow down evenly to leave a safe gap."
    )


def _on_straight(situation: Situation) -> tuple[float, str]:
    gap = situation.relative_distance - situation.vehicle_length
    closing = situation.own_speed - situation.other_speed
    if situation.relative_distance <= 0:
        return 0.0, "The other car is behind me. I keep my speed and leave the merge area."
    if closing > 0.1 and gap < 4 + 2 * closing:
        # v^2 = 2 a s, with a margin of 1 m and of 0.2 m/s^2.
        needed = -(closing**2) / (2 * max(gap - 1.0, 0.5)) - 0.2
        return max(HARDEST_BRAKING_MPS2, needed), (
            f"The other car is {gap:.1f} m ahead and slower. I brake until I match its speed."
        )
    return 0.0, "The other car is ahead at a sufficient distance. I keep my speed and follow it."


def _even_acceleration(gained_m: float, distance: float | None, speed: float) -> float:
    """Return the constant acceleration that gains a distance until the merge point."""
    # s = a t^2 / 2; a lower bound of t keeps the acceleration small near the merge point.
    seconds = max(SHORTEST_S, (distance or TRACK.merge_point_m) / max(speed, 0.1))
    return 2 * gained_m / seconds**2


def _quantity(name: str, unit: str, prompt: str) -> float | None:
    """Return a quantity from the prompt's list or table of the situation."""
    return _number(rf"{name}(?:: | \| )(\S+) (?:\| )?{unit}(?![\w/])", prompt)


def _number(pattern: str, prompt: str) -> float | None:
    match = re.search(pattern, prompt, re.MULTILINE)
    try:
        return float(match.group(1)) if match else None
    except ValueError:
        return None
