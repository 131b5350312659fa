"""Vehicle: a point mass on rails with an acceleration that is constant within a step."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from math import inf, sqrt

from merge_runner.config import Resistance, ScenarioConfig


@dataclass(slots=True)
class Vehicle:
    """Samples of one vehicle from step 0 on, in SI units.

    The acceleration of a step belongs to the sample at its end. ``merged`` is (step in which it was
    at the merge point, or inf; seconds after the beginning of that step).
    """

    positions: list[float]
    velocities: list[float]
    accelerations: list[float] = field(default_factory=lambda: [0.0])
    merged: tuple[float, float] = inf, 0.0

    def drive(
        self, actions: Sequence[float | None], config: ScenarioConfig, merge_point_m: float
    ) -> list[float]:
        """Drive a step with each action in [-1, 1] (None: cruise), and return the new positions."""
        step_s, first = config.step_s, len(self.positions)
        position, velocity = self.positions[-1], self.velocities[-1]
        for step, action in enumerate(actions, first - 1):
            acceleration = 0.0
            if action is not None:
                commanded = action * config.max_acceleration_mps2
                acceleration = net_acceleration(commanded, velocity, config.resistance)
            before_m, before_mps = position, velocity
            position, velocity = advance(before_m, before_mps, acceleration, step_s)
            if before_m < merge_point_m <= position:
                left_m = merge_point_m - before_m
                self.merged = step, time_to_reach(left_m, before_mps, acceleration)
            self.positions.append(position)
            self.velocities.append(velocity)
            # A vehicle that stops within the step executes less than the command.
            stopped = before_mps + acceleration * step_s < 0
            self.accelerations.append(-before_mps / step_s if stopped else acceleration)
        return self.positions[first:]


def advance(
    position_m: float, velocity_mps: float, acceleration_mps2: float, step_s: float
) -> tuple[float, float]:
    """Return position and velocity one step later; a braking vehicle stops and never reverses.

    Exact for a constant acceleration a: v + a t and s + v t + a t^2 / 2, or s + v^2 / (-2 a) if it
    stops before the end of the step.
    """
    velocity = velocity_mps + acceleration_mps2 * step_s
    if velocity >= 0:
        moved = velocity_mps * step_s + acceleration_mps2 * step_s**2 / 2
        return position_m + moved, velocity
    return position_m + velocity_mps**2 / (-2 * acceleration_mps2), 0.0


def net_acceleration(commanded_mps2: float, velocity_mps: float, resistance: Resistance) -> float:
    """Return the commanded acceleration less the human simulator's 0.5 + 0.005 v^2, if any."""
    if resistance == "none":
        return commanded_mps2
    return commanded_mps2 - 0.005 * velocity_mps**2 - 0.5


def time_to_reach(distance_m: float, velocity_mps: float, acceleration_mps2: float) -> float:
    """Return the time in s to cover a distance ahead, which the vehicle must reach."""
    # The root of s = v t + a t^2 / 2 in the form that does not divide by a, which may be 0.
    root = sqrt(max(0.0, velocity_mps**2 + 2 * acceleration_mps2 * distance_m))
    return 2 * distance_m / (velocity_mps + root) if distance_m > 0 else 0.0
