"""What a template may name in braces, and what is written there.

Numbers have two decimals, in m, s, m/s and m/s^2, or in the unit of their name; lists are those of
Python. What is about the other car is "not seen" while that is so, and without the unit that a
template has behind it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from statistics import fmean

from merge_runner.config import ScenarioConfig
from merge_runner.prompts.state_lines import LINES, NOT_SEEN
from merge_runner.records import Observation

KMH_OF_MPS = 3.6
MPH_OF_MPS = 3600 / 1609.344  # the international mile of 1959


@dataclass(frozen=True, slots=True)
class Situation:
    """What a prompt is about; ``plan`` is the rest of the last valid one, None before the first."""

    seen: Observation
    task: ScenarioConfig
    plan: Sequence[float] | None

    def of_other(self, value: float) -> str:
        """A number about the other car."""
        return decimal(value) if self.seen.other_seen else NOT_SEEN


def _own_accelerations(now: Situation) -> str:
    """The means of the world's samples over each action, the last of which ends now."""
    values, every = now.seen.own_accelerations_mps2, now.task.action_steps
    starts = range(len(values) % every, len(values), every)
    return listing(values if every == 1 else [fmean(values[i : i + every]) for i in starts])


def _other_speeds(now: Situation) -> str:
    """One of the world's samples for each action; the last of them is one action before now."""
    if not now.seen.other_seen:
        return NOT_SEEN
    values, every = now.seen.other_speeds_mps, now.task.action_steps
    return listing(values[len(values) % every :: every])


def _remaining_plan(now: Situation) -> str:
    if now.plan is None:
        return "none, this is your first decision"
    return f"{listing(now.plan)}, one value every {now.task.action_s:g} s, next first"


def _line(line: Callable[[Observation], str], now: Situation) -> str:
    return line(now.seen)


FIELDS: Mapping[str, Callable[[Situation], str]] = {
    "vehicle_length": lambda now: f"{now.task.vehicle_length_m:g}",
    "own_speed": lambda now: decimal(now.seen.own_speed_mps),
    "other_speed": lambda now: now.of_other(now.seen.other_speed_mps),
    "own_speed_kmh": lambda now: decimal(now.seen.own_speed_mps * KMH_OF_MPS),
    "other_speed_kmh": lambda now: now.of_other(now.seen.other_speed_mps * KMH_OF_MPS),
    "own_speed_mph": lambda now: decimal(now.seen.own_speed_mps * MPH_OF_MPS),
    "other_speed_mph": lambda now: now.of_other(now.seen.other_speed_mps * MPH_OF_MPS),
    # Own minus other.
    "relative_speed": lambda now: now.of_other(now.seen.own_speed_mps - now.seen.other_speed_mps),
    # How far the other car is ahead, negative if it is behind.
    "relative_distance": lambda now: now.of_other(now.seen.relative_distance_m),
    # Before the merge point alone.
    "distance_to_merge": lambda now: decimal(now.seen.distance_to_merge_m or 0.0),
    "own_accelerations": _own_accelerations,
    "other_speeds": _other_speeds,
    "remaining_plan": _remaining_plan,
    "memory_s": lambda now: f"{now.task.memory_s:g}",
    "horizon_s": lambda now: f"{now.task.horizon_s:g}",
    "step_s": lambda now: f"{now.task.action_s:g}",
    "prompt_interval_s": lambda now: f"{1 / now.task.prompt_rate_hz:g}",
    "plan_actions": lambda now: str(now.task.plan_actions),
    "max_acceleration": lambda now: f"{now.task.max_acceleration_mps2:g}",
    **{name: partial(_line, line) for name, line in LINES.items()},
}


def decimal(value: float) -> str:
    """Two decimals, and never a negative zero."""
    return f"{value:.2f}".replace("-0.00", "0.00")


def listing(values: Iterable[float]) -> str:
    """Values as a Python list of two decimals."""
    return f"[{', '.join([f'{value:.2f}' for value in values])}]".replace("-0.00", "0.00")
