"""The program ``idm``: the intelligent driver model, with a virtual leader before the merge."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from math import sqrt

from merge_runner.drivers.base import DriverContext, Parameter
from merge_runner.drivers.registry import PROGRAMS, Program
from merge_runner.errors import UsageError
from merge_runner.records import Decision, Observation

SETS = {
    # Farama-Foundation/HighwayEnv, highway_env/vehicle/behavior.py. Its jam distance is 5 m net:
    # it measures between centres, and adds the length of a vehicle.
    "highway-env": {
        "max_acceleration_mps2": 3.0,
        "comfortable_braking_mps2": 5.0,
        "headway_s": 1.5,
        "jam_distance_m": 5.0,
        "exponent": 4.0,
    },
    # Treiber and Kesting, Traffic Flow Dynamics (2013), table 11.2.
    "treiber-kesting": {
        "max_acceleration_mps2": 1.0,
        "comfortable_braking_mps2": 1.5,
        "headway_s": 1.0,
        "jam_distance_m": 2.0,
        "exponent": 4.0,
    },
}
# Bounds of all parameters: within them no power overflows.
LEAST, MOST, MOST_EXPONENT = 0.001, 1000, 40
SHORTEST_GAP_M = 0.1  # a virtual leader may be level with its follower
SLOWEST_MPS = 0.1
TIE_S = 1e-6


@dataclass(slots=True)
class IdmDriver:
    """Driver that follows the other if that is projected to reach the merge point first.

    On a tie the side with the higher seed goes first, so that exactly one of two yields. The
    desired speed is ``desired_speed_factor`` times the speed at the first decision.
    """

    context: DriverContext
    _desired_mps: float | None = None

    async def decide(self, observation: Observation, number: int) -> Decision:
        """Accelerate freely, or follow."""
        seen = observation
        if self._desired_mps is None:
            first_mps = max(seen.own_speed_mps, SLOWEST_MPS)
            self._desired_mps = self.context.number("desired_speed_factor") * first_mps
        acceleration = self._free(seen.own_speed_mps, self._desired_mps)
        if not self._leads(seen):
            acceleration -= self._interaction(seen)
        return self.context.accelerating(acceleration, seen.own_speed_mps)

    def _free(self, speed_mps: float, desired_mps: float) -> float:
        share: float = (speed_mps / desired_mps) ** self.context.number("exponent")
        return self.context.number("max_acceleration_mps2") * (1 - share)

    def _interaction(self, seen: Observation) -> float:
        """Return the deceleration a (s*/s)^2 behind the leader."""
        most = self.context.number("max_acceleration_mps2")
        gap = max(seen.relative_distance_m - self.context.scenario.vehicle_length_m, SHORTEST_GAP_M)
        speed = seen.own_speed_mps
        closing = speed - seen.other_speed_mps
        braking = 2 * sqrt(most * self.context.number("comfortable_braking_mps2"))
        dynamic = speed * self.context.number("headway_s") + speed * closing / braking
        desired_gap = self.context.number("jam_distance_m") + max(0.0, dynamic)
        return most * (desired_gap / gap) ** 2

    def _leads(self, seen: Observation) -> bool:
        distance = seen.distance_to_merge_m
        other_distance = None if distance is None else distance - seen.relative_distance_m
        if distance is None or other_distance is None or min(distance, other_distance) <= 0:
            return seen.relative_distance_m < 0
        own_s = distance / max(seen.own_speed_mps, SLOWEST_MPS)
        other_s = other_distance / max(seen.other_speed_mps, SLOWEST_MPS)
        if abs(own_s - other_s) <= TIE_S:
            return self.context.seed > self.context.other_seed
        return own_s < other_s


def _check(parameters: Mapping[str, Parameter]) -> None:
    for name, value in parameters.items():
        most = MOST_EXPONENT if name == "exponent" else MOST
        if not isinstance(value, str) and not LEAST <= value <= most:
            raise UsageError(f"{name} of idm must be from {LEAST} to {most}")


PROGRAMS.register(
    "idm",
    Program(
        IdmDriver,
        "follows the driver projected to arrive first, by the intelligent driver model",
        {"set": "highway-env", "desired_speed_factor": 1.0},
        20.0,
        settable=True,
        sets=SETS,
        check=_check,
        chance=True,
    ),
)
