"""A scripted human-like driver that reads the prompt and answers in free text, as a model would.

Who goes first is drawn from the human logistic odds, or from those that a request plants
(``planted_effect``), once for a trial and shared by both sides. Both hold piecewise constant
accelerations that open a gap. In every third repetition, in one condition, the driver
that should yield misjudges: it keeps level with the other, and they collide.

Beside it a driver that understands nothing draws its answers to any prompt at random: it rehearses
a study whose prompts the scripted driver cannot read.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass

from merge_runner.chance import draw, draw_between, draw_index, draw_normal
from merge_runner.planted_effect import PlantedEffect
from merge_runner.prompts.state_lines import NOT_SEEN
from merge_runner.records import FAR_BEHIND_M, Slot
from merge_runner.scenarios.merge.conditions import CONDITIONS, HUMAN_CONDITIONS
from merge_runner.scenarios.merge.geometry import TRACK

VEHICLE_LENGTH_M = 4.5
MAX_ACCELERATION_MPS2 = 2.5
SHORTEST_S = 1.0
HUMAN = PlantedEffect()
# What every prompt must say.
NEEDED = (
    "Your speed: N m/s",
    "Speed of the other car: N m/s",
    "Relative distance (of the other car, ahead of you): N m",
    "exactly N numbers",
)
HARDEST_BRAKING_MPS2, HARDEST_PUSH_MPS2 = -2.2, 1.4
# The most actions of a plan, and the lengths that it usually has, for the random driver.
MOST_ACTIONS, USUAL_LENGTHS = 200, range(1, 31)


@dataclass(frozen=True, slots=True)
class Seen:
    """What the prompt says, in SI units."""

    own_speed: float
    other_speed: float
    relative_distance: float
    distance_to_merge: float | None
    asks_tactical: bool
    plan_actions: int
    vehicle_length: float
    other_acceleration: float
    """From the last two seen speeds of the other; 0 where the prompt has no history."""
    previous: float | None
    """The next action of the previous plan, normalised."""
    other_seen: bool = True

    @property
    def other_distance_to_merge(self) -> float:
        """The other vehicle's distance to the merge point, negative once it has passed."""
        return (self.distance_to_merge or 0.0) - self.relative_distance


@dataclass(frozen=True, slots=True)
class Temper:
    """What is drawn for a trial: who goes first, the gap aimed at, and who does how much.

    ``misjudges`` says that this driver goes first although the other does.
    """

    goes_first: bool
    misjudges: bool
    target_gap_m: float
    leader_share: float


def answer(prompt: str, slot: Slot | None, effect: PlantedEffect | None = None) -> str:
    """The reply's text for a prompt; without a slot it depends on the prompt alone."""
    seen = read_prompt(prompt)
    if isinstance(seen, str):
        return seen
    temper = temper_for(seen, slot, None if effect is None else effect.before(prompt))
    if not seen.other_seen:
        action, why = 0.0, "I do not see the other car, and keep my speed."
    elif seen.distance_to_merge is None:
        action, why = _on_straight(seen)
    elif temper.goes_first:
        action, why = _go_first(seen, temper, slot)
    else:
        action, why = _yield(seen, temper, slot)
    normalised = round(min(1.0, max(-1.0, action / MAX_ACCELERATION_MPS2)), 2) + 0.0
    plan = ", ".join([f"{normalised:.2f}"] * seen.plan_actions)
    token = ("M\n\n" if temper.goes_first else "Y\n\n") if seen.asks_tactical else ""
    return f"{token}{why}\n\n```python\n[{plan}]\n```"


def random_answer(prompt: str, slot: Slot | None) -> str:
    """Return M or Y and a plan, both drawn at random; without a slot by the prompt alone."""
    drawn_for = (prompt, *(() if slot is None else slot.as_dict().values()))
    word = "M" if draw("word", *drawn_for) < 0.5 else "Y"
    action = f"{round(draw_between(-1, 1, 'action', *drawn_for), 2) + 0.0:.2f}"
    lengths = {int(number) for number in re.findall(r"exactly (\d+) numbers", prompt)}
    if not lengths:
        # The parser takes the list of the right length, whatever others stand beside it.
        mentioned = map(int, re.findall(r"(?<![\d.])\d{1,3}(?!\.?\d)", prompt))
        lengths = {*USUAL_LENGTHS, *(n for n in mentioned if 0 < n <= MOST_ACTIONS)}
    plans = "\n".join(f"[{', '.join([action] * length)}]" for length in sorted(lengths))
    return f"{word}\n\nI draw lots and hold what I draw.\n\n```python\n{plans}\n```"


def read_prompt(prompt: str) -> Seen | str:
    """The situation that a prompt describes, or an answer that says which words it lacks."""
    own = _quantity("Your speed", "m/s", prompt)
    other = _quantity("Speed of the other car", "m/s", prompt)
    relative = _quantity("Relative distance .*?", "m", prompt)
    actions = _number(r"exactly (\d+) numbers", prompt)
    other_seen = not re.search(rf"Speed of the other car(?:: | \| ){NOT_SEEN}", prompt)
    if not other_seen:
        other, relative = own, -FAR_BEHIND_M
    if own is None or other is None or relative is None or actions is None:
        needed = zip(NEEDED, (own, other, relative, actions), strict=True)
        lacking = ", ".join(f"`{words}`" for words, number in needed if number is None)
        return (
            "I am the emulator, a scripted driver and no language model, and cannot read this "
            f"prompt: it does not say {lacking}, with a number for N. The model `random` answers "
            "any prompt."
        )
    return Seen(
        own_speed=own,
        other_speed=other,
        relative_distance=relative,
        distance_to_merge=_quantity("Your distance to the merge point", "m", prompt),
        asks_tactical="merge first (M) or yield" in prompt,
        plan_actions=int(actions),
        vehicle_length=_quantity("Length of each car", "m", prompt) or VEHICLE_LENGTH_M,
        other_acceleration=_other_acceleration(prompt, other),
        previous=_number(r"not been executed yet\): \[([^,\]]+)", prompt),
        other_seen=other_seen,
    )


def temper_for(seen: Seen, slot: Slot | None, effect: PlantedEffect | None) -> Temper:
    """The trial's draws; without a slot the projected order decides who goes first."""
    added_gap_m = 0.0 if effect is None else effect.x_gap_m
    if slot is None:
        return Temper(_projected_lead_m(seen) > 0, False, 3.85 + added_gap_m, 0.5)
    trial: tuple[object, ...] = (slot.condition, slot.repetition, slot.sample_set)
    if effect is not None:  # trials with another effect are drawn independently
        trial += (effect.model_dump_json(),)
    noise = draw_normal("noise", *trial)
    chance = _chance_left_first(effect or HUMAN, slot.condition, noise)
    left_first = draw("who first", *trial) < chance
    goes_first = (slot.side == "left") == left_first
    misjudges = not goes_first and _somebody_misjudges(slot)
    return Temper(
        goes_first=goes_first or misjudges,
        misjudges=misjudges,
        target_gap_m=draw_between(1.8, 6.5, "gap", *trial) + added_gap_m,
        leader_share=draw_between(0.1, 0.7, "share", *trial),
    )


def _chance_left_first(effect: PlantedEffect, condition: str, noise: float) -> float:
    kinematics = CONDITIONS.get(condition)
    if kinematics is None:  # a study's own: this process may not know it
        return 0.5
    intercept, of_headway, of_speed = effect.coefficients
    logit = (
        intercept
        + of_headway * kinematics.projected_headway_m
        + of_speed * kinematics.relative_velocity_mps
        + effect.x_noise * noise
    )
    return 1 / (1 + math.exp(-max(logit, -700.0)))  # exp of more than 709 overflows


def _somebody_misjudges(slot: Slot) -> bool:
    """Whether a driver misjudges here: in one human condition of every third repetition."""
    turn = draw_index(3, "misjudge turn", slot.sample_set)
    names = list(HUMAN_CONDITIONS)
    chosen = draw_index(len(names), "misjudged condition", slot.repetition, slot.sample_set)
    return slot.repetition % 3 == turn and names[chosen] == slot.condition


def _go_first(seen: Seen, temper: Temper, slot: Slot | None) -> tuple[float, str]:
    if seen.other_distance_to_merge <= 0:
        return 0.0, "The other car is through already, so I keep my speed and stay behind it."
    leading = _projected_lead_m(seen)
    if temper.misjudges:
        catch_up = _even_acceleration(-leading, seen.distance_to_merge, seen.own_speed)
        action = min(MAX_ACCELERATION_MPS2, max(0.0, seen.other_acceleration + catch_up))
        return action, _phrase(
            slot,
            "I take the gap: with enough speed I reach the merge point before the other car, "
            "which should let me in. I keep an eye on it.",
        )
    lacking = _lacking_m(leading, seen, temper)
    push = _even_acceleration(temper.leader_share * lacking, seen.distance_to_merge, seen.own_speed)
    action = min(HARDEST_PUSH_MPS2, max(0.0, push))
    return _settled(action, seen, slot), _phrase(
        slot,
        f"At present speeds I would be {leading:.1f} m ahead at the merge point. I go first and "
        "make the gap clear by my speed, and hold this acceleration.",
    )


def _yield(seen: Seen, temper: Temper, slot: Slot | None) -> tuple[float, str]:
    other_distance = seen.other_distance_to_merge
    if other_distance <= 0:
        return _on_straight(seen)
    behind = -_projected_lead_m(seen)
    lacking = _lacking_m(behind, seen, temper)
    share = 1 - temper.leader_share
    brake = -_even_acceleration(share * lacking, other_distance, seen.other_speed)
    action = min(0.0, max(HARDEST_BRAKING_MPS2, brake))
    return _settled(action, seen, slot), _phrase(
        slot,
        f"The other car will be about {behind:.1f} m ahead at the merge point if nobody acts. I "
        "let it go first and slow down evenly to leave a safe gap.",
    )


def _on_straight(seen: Seen) -> tuple[float, str]:
    gap = seen.relative_distance - seen.vehicle_length
    closing = seen.own_speed - seen.other_speed
    if seen.relative_distance <= 0:
        return 0.0, "The other car is behind me. I keep my speed and leave the merge area."
    if closing > 0.1 and gap < 4 + 2 * closing:
        # From v^2 = 2 a s, with 1 m to spare and a little more.
        needed = -(closing**2) / (2 * max(gap - 1.0, 0.5)) - 0.2
        return max(HARDEST_BRAKING_MPS2, needed), (
            f"The other car is {gap:.1f} m ahead and slower. I brake until I match its speed."
        )
    return 0.0, "The other car is ahead at a sufficient distance. I keep my speed and follow it."


def _settled(action: float, seen: Seen, slot: Slot | None) -> float:
    """Hold the level of the previous plan unless the need has moved away from it."""
    held = None if seen.previous is None else seen.previous * MAX_ACCELERATION_MPS2
    if held is not None and abs(action - held) < 0.25:
        return held
    wobble = 0.0 if slot is None else draw_between(-0.05, 0.05, "wobble", *slot.as_dict().values())
    return action + wobble


def _lacking_m(lead: float, seen: Seen, temper: Temper) -> float:
    """How far the leader's projected lead falls short; a leader from behind acts at once."""
    return temper.target_gap_m + seen.vehicle_length - lead + max(0.0, 1.0 - lead)


def _projected_lead_m(seen: Seen) -> float:
    """How far ahead of the other the ego would be when the first one reaches the merge point."""
    own = (seen.distance_to_merge or 0.0) / max(seen.own_speed, 0.1)
    other = max(seen.other_distance_to_merge, 0.0) / max(seen.other_speed, 0.1)
    seconds = min(own, other)
    return (seen.own_speed - seen.other_speed) * seconds - seen.relative_distance


def _even_acceleration(metres: float, distance: float | None, speed: float) -> float:
    """The constant acceleration that gains a distance before the leader reaches the merge point."""
    # From s = a t^2 / 2; near the merge point t is bounded, for a to stay within reason.
    seconds = max(SHORTEST_S, (distance or TRACK.merge_point_m) / max(speed, 0.1))
    return 2 * metres / seconds**2


def _phrase(slot: Slot | None, reason: str) -> str:
    if slot is None:
        return reason
    openings = (
        "Neither of us has the right of way.",
        "We approach the merge point at nearly the same time.",
        "I compare when each of us arrives at the merge point.",
    )
    return f"{openings[draw_index(len(openings), 'words', *slot.as_dict().values())]} {reason}"


def _other_acceleration(prompt: str, speed_now: float) -> float:
    before = _number(r"Observed speeds of the other car .*[\[ ]([^, \]]+)\]$", prompt)
    step = _number(r"one value every (\S+) s", prompt)
    return (speed_now - before) / step if before is not None and step else 0.0


def _quantity(name: str, unit: str, prompt: str) -> float | None:
    """A quantity in the list of the situation, or in its table."""
    return _number(rf"{name}(?:: | \| )(\S+) (?:\| )?{unit}(?![\w/])", prompt)


def _number(pattern: str, prompt: str) -> float | None:
    match = re.search(pattern, prompt, re.MULTILINE)
    try:
        return float(match.group(1)) if match else None
    except ValueError:
        return None
