"""The program ``quantal``: level-1 quantal response on four actions, a model of our own."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from math import exp
from random import Random

from merge_runner.drivers.base import DriverContext, Parameter
from merge_runner.drivers.registry import PROGRAMS, Program
from merge_runner.errors import UsageError
from merge_runner.records import Decision, Observation
from merge_runner.scenarios.merge.collision import collided
from merge_runner.scenarios.merge.geometry import TRACK
from merge_runner.scenarios.merge.vehicle import advance

NODE_S = 0.2
SLOWEST_MPS = 0.5


@dataclass(slots=True)
class QuantalDriver:
    """Driver that assumes a constant speed of the other, and draws an action by its cost.

    An action is held until the next decision, and both speeds are constant after it. Its cost is
    the sum of lost time, squared acceleration, and a collision within the horizon, each weighted.
    The probability of an action is proportional to exp(-precision * cost).
    """

    context: DriverContext
    _desired_mps: float | None = None
    _random: Random = field(init=False)

    def __post_init__(self) -> None:
        self._random = Random(self.context.seed)

    async def decide(self, observation: Observation, number: int) -> Decision:
        """Draw an action."""
        if self._desired_mps is None:
            self._desired_mps = max(observation.own_speed_mps, SLOWEST_MPS)
        costs = {action: self._cost(observation, action) for action in self._actions()}
        precision, least = self.context.number("precision"), min(costs.values())
        weights = [exp(-precision * (cost - least)) for cost in costs.values()]
        (action,) = self._random.choices(list(costs), weights)
        return self.context.accelerating(action, observation.own_speed_mps)

    def _actions(self) -> tuple[float, ...]:
        number = self.context.number
        return (
            -number("hard_braking_mps2"),
            -number("braking_mps2"),
            0.0,
            number("acceleration_mps2"),
        )

    def _cost(self, seen: Observation, action_mps2: float) -> float:
        assert self._desired_mps is not None
        number, held_s = self.context.number, self.context.interval_s
        ahead_m, speed_mps = advance(0.0, seen.own_speed_mps, action_mps2, held_s)
        rest_m = max(0.0, TRACK.end_m - seen.own_position_m - ahead_m)
        needed_s = held_s + rest_m / max(speed_mps, SLOWEST_MPS)
        lost_s = max(0.0, needed_s - (ahead_m + rest_m) / self._desired_mps)
        return (
            number("time_weight") * lost_s
            + number("effort_weight") * action_mps2**2 * held_s
            + number("collision_cost") * self._leads_to_a_collision(seen, action_mps2)
        )

    def _leads_to_a_collision(self, seen: Observation, action_mps2: float) -> bool:
        """Return True if both collide between the end of the action and the horizon."""
        own_m, speed_mps = advance(
            seen.own_position_m, seen.own_speed_mps, action_mps2, self.context.interval_s
        )
        other_m = seen.own_position_m + seen.relative_distance_m
        left_s = self.context.number("horizon_s") - self.context.interval_s
        nodes = range(int(left_s / NODE_S) + 1)
        times_s = [NODE_S * node for node in nodes]
        return any(
            self._collided(
                own_m + speed_mps * time_s,
                other_m + seen.other_speed_mps * (self.context.interval_s + time_s),
            )
            for time_s in times_s
        )

    def _collided(self, own_m: float, other_m: float) -> bool:
        places = (own_m, other_m) if self.context.side == "left" else (other_m, own_m)
        return collided(self.context.scenario, TRACK, *places)


def _check(parameters: Mapping[str, Parameter]) -> None:
    for name, value in parameters.items():
        if float(value) < 0:
            raise UsageError(f"{name} of quantal cannot be below 0")


def _check_clock(parameters: Mapping[str, Parameter], clock_s: float) -> None:
    if float(parameters["horizon_s"]) < clock_s:
        raise UsageError(f"horizon_s of quantal is at least its clock, {clock_s:g} s")


PROGRAMS.register(
    "quantal",
    Program(
        QuantalDriver,
        "each second draws one of four accelerations, those that cost less time, effort and "
        "collisions more often, if the other keeps its speed (our own model)",
        {
            "horizon_s": 5.0,
            "precision": 1.7,
            "collision_cost": 2.3,
            "time_weight": 0.7,
            "effort_weight": 0.14,
            "hard_braking_mps2": 2.5,
            "braking_mps2": 1.5,
            "acceleration_mps2": 0.5,
        },
        1.0,
        settable=True,
        check=_check,
        check_clock=_check_clock,
        chance=True,
    ),
)
