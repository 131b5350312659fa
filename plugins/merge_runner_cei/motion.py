"""What a driver knows of vehicles: how they move under a constant input, for many at once."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from merge_runner.config import ScenarioConfig
from merge_runner.scenarios.merge.geometry import Track
from merge_runner.scenarios.merge.vehicle import net_acceleration
from merge_runner_cei.collision_interval import CollisionInterval, collision_interval
from merge_runner_cei.parameters import NODE_S, NODES

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class Task:
    """The vehicles' strength and resistance, and where they collide."""

    scenario: ScenarioConfig
    track: Track
    interval: CollisionInterval

    def net_mps2(self, inputs: Array, speeds_mps: Array) -> Array:
        """The acceleration that an input in [-1, 1] leads to."""
        # The world's own rule, which is of numbers: numpy's arrays obey it element by element.
        commanded: Any = inputs * self.scenario.max_acceleration_mps2
        speeds: Any = speeds_mps
        return np.asarray(net_acceleration(commanded, speeds, self.scenario.resistance))


def task_of(scenario: ScenarioConfig, track: Track) -> Task:
    """What there is to know of a scenario."""
    boxes = scenario.vehicle_length_m, scenario.vehicle_width_m
    return Task(scenario, track, collision_interval(track, *boxes))


def move(
    positions_m: Array, speeds_mps: Array, accelerations_mps2: Array, step_s: float
) -> tuple[Array, Array]:
    """Positions and speeds one step later, as ``scenarios.merge.vehicle.advance`` of each."""
    after = speeds_mps + accelerations_mps2 * step_s
    driven = speeds_mps * step_s + accelerations_mps2 * step_s**2 / 2
    stops = after < 0
    if stops.any():
        stopping = np.where(stops, -2 * accelerations_mps2, 1.0)
        driven = np.where(stops, speeds_mps**2 / stopping, driven)
    return positions_m + driven, np.maximum(after, 0.0)


@dataclass(frozen=True, slots=True)
class Course:
    """What constant inputs lead to: arrays of the shape (nodes from now on, ...)."""

    positions_m: Array
    speeds_mps: Array
    accelerations_mps2: Array

    def cost(self, desired_mps: Array) -> Array:
        """How far off the desired speed, and how hard to drive, over all nodes."""
        off = self.speeds_mps - desired_mps
        return np.asarray((off**2 + self.accelerations_mps2**2).sum(axis=0))


def course(task: Task, positions_m: Array, speeds_mps: Array, inputs: Array) -> Course:
    """The way ahead, the present first and then every 0.25 s, under inputs that are held."""
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
