"""A vehicle: a point mass on rails, moved by an acceleration that is constant within a step."""

from __future__ import annotations

from dataclasses import dataclass, field
from math import sqrt

from merge_runner.config import Resistance, ScenarioConfig


@dataclass(slots=True)
class Vehicle:
    """The samples of one vehicle from step 0 on, in SI units.

    The acceleration of a step stands with the sample at its end. ``merged`` is the step in which it
    was at the merge point, and how many s after its beginning.
    """

    positions: list[float]
    velocities: list[float]
    accelerations: list[float] = field(default_factory=lambda: [0.0])
    merged: tuple[int, float] | None = None

    def drive(self, action: float | None, config: ScenarioConfig, merge_point_m: float) -> float:
        """Drive a step with an action in [-1, 1], None: cruise; returns the new position."""
        position, velocity = self.positions[-1], self.velocities[-1]
        step_s, acceleration = config.step_s, 0.0
        if action is not None:
            commanded = action * config.max_acceleration_mps2
            acceleration = net_acceleration(commanded, velocity, config.resistance)
        new_position, new_velocity = advance(position, velocity, acceleration, step_s)
        if position < merge_point_m <= new_position:
            left_m = merge_point_m - position
            self.merged = len(self.positions) - 1, time_to_reach(left_m, velocity, acceleration)
        self.positions.append(new_position)
        self.velocities.append(new_velocity)
        # Where the vehicle stopped within the step, what it executed is less than the command.
        stopped = velocity + acceleration * step_s < 0
        self.accelerations.append(-velocity / step_s if stopped else acceleration)
        return new_position


def advance(
    position_m: float, velocity_mps: float, acceleration_mps2: float, step_s: float
) -> tuple[float, float]:
    """Position and velocity one step later; a braking vehicle stops and stays, never reverses.

    Exact for a constant acceleration a: v + a t and s + v t + a t^2 / 2, or s + v^2 / (-2 a) where
    it stops before the step ends.
    """
    velocity = velocity_mps + acceleration_mps2 * step_s
    if velocity >= 0:
        moved = velocity_mps * step_s + acceleration_mps2 * step_s**2 / 2
        return position_m + moved, velocity
    return position_m + velocity_mps**2 / (-2 * acceleration_mps2), 0.0


def net_acceleration(commanded_mps2: float, velocity_mps: float, resistance: Resistance) -> float:
    """The commanded acceleration less the resistance (the human simulator's: 0.5 + 0.005 v^2)."""
    if resistance == "none":
        return commanded_mps2
    return commanded_mps2 - 0.005 * velocity_mps**2 - 0.5


def time_to_reach(distance_m: float, velocity_mps: float, acceleration_mps2: float) -> float:
    """The time in s in which a distance ahead is covered; the vehicle must reach it."""
    # The root of s = v t + a t^2 / 2 in the form that does not divide by a, which may be 0.
    root = sqrt(max(0.0, velocity_mps**2 + 2 * acceleration_mps2 * distance_m))
    return 2 * distance_m / (velocity_mps + root) if distance_m > 0 else 0.0
