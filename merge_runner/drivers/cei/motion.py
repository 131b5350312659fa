"""Motion of vehicles under a constant input, as arrays."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from merge_runner.config import ScenarioConfig
from merge_runner.drivers.cei.collision_interval import CollisionInterval, collision_interval
from merge_runner.drivers.cei.parameters import NODE_S, NODES
from merge_runner.scenarios.merge.geometry import Track
from merge_runner.scenarios.merge.vehicle import net_acceleration

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class Task:
    """Acceleration and resistance of the vehicles, and the interval in which they collide."""

    scenario: ScenarioConfig
    track: Track
    interval: CollisionInterval

    def net_mps2(self, inputs: Array, speeds_mps: Array) -> Array:
        """Return the net accelerations under inputs in [-1, 1]."""
        # The world's rule is typed for numbers; numpy applies it element by element.
        commanded: Any = inputs * self.scenario.max_acceleration_mps2
        speeds: Any = speeds_mps
        return np.asarray(net_acceleration(commanded, speeds, self.scenario.resistance))


def task_of(scenario: ScenarioConfig, track: Track) -> Task:
    """Return the task of a scenario."""
    boxes = scenario.vehicle_length_m, scenario.vehicle_width_m
    return Task(scenario, track, collision_interval(track, *boxes))


def move(
    positions_m: Array, speeds_mps: Array, accelerations_mps2: Array, step_s: float
) -> tuple[Array, Array]:
    """Return positions and speeds after a step, as ``scenarios.merge.vehicle.advance`` does."""
    after = speeds_mps + accelerations_mps2 * step_s
    driven = speeds_mps * step_s + accelerations_mps2 * step_s**2 / 2
    stops = after < 0
    if stops.any():
        stopping = np.where(stops, -2 * accelerations_mps2, 1.0)
        driven = np.where(stops, speeds_mps**2 / stopping, driven)
    return positions_m + driven, np.maximum(after, 0.0)


@dataclass(frozen=True, slots=True)
class Course:
    """Predicted motion under constant inputs: arrays of the shape (nodes from now on, ...)."""

    positions_m: Array
    speeds_mps: Array
    accelerations_mps2: Array

    def cost(self, desired_mps: Array) -> Array:
        """Return the sum of squared speed errors and accelerations over all nodes."""
        error_mps = self.speeds_mps - desired_mps
        return np.asarray((error_mps**2 + self.accelerations_mps2**2).sum(axis=0))


def course(task: Task, positions_m: Array, speeds_mps: Array, inputs: Array) -> Course:
    """Return the motion under held inputs, now and then every 0.25 s."""
    shape = (NODES + 1, *np.broadcast_shapes(positions_m.shape, inputs.shape))
    position, speed, acceleration = np.empty(shape), np.empty(shape), np.empty(shape)
    position[0], speed[0] = positions_m, speeds_mps
    for node in range(NODES):
        acceleration[node] = task.net_mps2(inputs, speed[node])
        position[node + 1], speed[node + 1] = move(
            position[node], speed[node], acceleration[node], NODE_S
        )
    acceleration[NODES] = task.net_mps2(inputs, speed[NODES])
    return Course(position, speed, acceleration)
