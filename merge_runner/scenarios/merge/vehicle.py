"""A vehicle: a point mass on rails, moved by an acceleration that is constant within a step."""

from __future__ import annotations

from math import sqrt

from merge_runner.config import Resistance


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
