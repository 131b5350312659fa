"""Simulation of many trials of the model at once: vehicles as arrays.

A trial that starts at the tunnels' exits is, sample by sample, the one that the runner plays with
two of the model's drivers at 20 Hz (to 1e-9). One that starts in the tunnels is the published
simulation, with its cruise control.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from merge_runner.drivers.cei.agents import Model, Vehicles, set_speeds, start, tunnel_ticks
from merge_runner.drivers.cei.motion import Array, Mask, Task, move
from merge_runner.drivers.cei.parameters import CRUISE_DAMPING, CRUISE_GAIN, TICK_S, Base
from merge_runner.scenarios.merge.collision import collided
from merge_runner.scenarios.merge.conditions import Condition

RUNNING = ""
NOBODY = Base(1.0, 1.0)


@dataclass(frozen=True, slots=True)
class Trial:
    """Trial to simulate: its condition, and drivers and seeds of both vehicles, left first.

    Without a driver (None) a vehicle keeps its speed by its cruise control.
    """

    condition: Condition
    drivers: tuple[Base | None, Base | None]
    seeds: tuple[int, int]


@dataclass(frozen=True, slots=True)
class Traces:
    """Traces and outcomes of n trials.

    ``positions_m`` and ``speeds_mps`` have the shape (samples, 2, n), left first; samples are 50 ms
    apart, and those after a trial's end repeat its last. ``control_at`` and ``ended_at`` are the
    samples at which the drivers take over and the trial ends; ``status`` is how it ends.
    """

    positions_m: Array
    speeds_mps: Array
    control_at: NDArray[np.int64]
    ended_at: NDArray[np.int64]
    status: NDArray[np.str_]


def simulate(model: Model, trials: Sequence[Trial], *, tunnel: bool = False) -> Traces:
    """Play trials from when both vehicles have left their tunnels, or from the start in these."""
    world = _World(model, trials, tunnel=tunnel)
    while world.running.size:
        world.step()
    return Traces(
        np.array(world.positions_m),
        np.array(world.speeds_mps),
        world.control_at,
        world.ended_at,
        world.status,
    )


class _World:
    """Trials under way; those that have ended drop out of ``running`` and of the agents.

    Agents, and arrays of their vehicles, are all left ones and then all right ones.
    """

    def __init__(self, model: Model, trials: Sequence[Trial], *, tunnel: bool) -> None:
        self.model, self.task = model, model.task
        begins = [
            0.0 if tunnel else max(trial.condition.exit_times_s(self.task.track))
            for trial in trials
        ]
        places = [
            trial.condition.positions_m(at, self.task.track)
            for trial, at in zip(trials, begins, strict=True)
        ]
        self.positions_m = [np.array(places).T]
        self.speeds_mps = [np.array([trial.condition.speeds_mps for trial in trials]).T]
        self.accelerations = np.zeros(2 * len(trials))
        self.error = np.zeros(2 * len(trials))
        seeds = [trial.seeds[side] for side in (0, 1) for trial in trials]
        self.noise = np.stack([_noise(seed, self.task.scenario.timeout_s) for seed in seeds], 1)
        self.running = np.arange(len(trials))
        self.status = np.full(len(trials), RUNNING, "<U8")
        self.ended_at = np.zeros(len(trials), np.int64)
        self.control_at = np.zeros(len(trials), np.int64)
        vehicles = self._vehicles()
        others = _others(vehicles)
        drivers = [trial.drivers[side] for side in (0, 1) for trial in trials]
        self.driven = np.array([driver is not None for driver in drivers])
        # At their start vehicles have the speeds that their cruise controls are set to.
        desired = vehicles.speeds_mps if tunnel else set_speeds(self.task, vehicles.speeds_mps)
        ticks = np.zeros(len(seeds)) if tunnel else tunnel_ticks(vehicles, others)
        bases = [driver or NOBODY for driver in drivers]
        self.agents = start(model, bases, vehicles, others, desired, ticks, self.noise[0])
        self._end()

    def step(self) -> None:
        """All observe and decide, and all are driven for 50 ms."""
        sample = len(self.positions_m)
        vehicles = self._vehicles()
        others = _others(vehicles)
        both = np.concatenate([self.running, self.running + self.status.size])
        noise = self.noise[sample][both]
        out = vehicles.positions_m.reshape(2, -1).min(axis=0) > self.task.track.tunnel_exit_m - 1e-9
        self.control_at[self.running[~out]] = sample
        controls = np.concatenate([out, out]) & self.driven[both]
        agents = self.agents
        agents.perceive(self.model, others, _swapped(self.accelerations), noise[:, 0])
        agents.decide(self.model, vehicles, others, noise[:, 1], controls)
        error = agents.desired_mps - vehicles.speeds_mps
        damping = CRUISE_DAMPING * (self.error - error) / TICK_S
        cruise = np.clip(CRUISE_GAIN * error - damping, -1, 1)
        self.error = error
        inputs = np.where(controls, agents.inputs, cruise)
        net_mps2 = self.task.net_mps2(inputs, vehicles.speeds_mps)
        positions, speeds = move(vehicles.positions_m, vehicles.speeds_mps, net_mps2, TICK_S)
        # Where a vehicle stops within the step, it executes less than the command.
        stops = vehicles.speeds_mps + net_mps2 * TICK_S < 0
        self.accelerations = np.where(stops, -vehicles.speeds_mps / TICK_S, net_mps2)
        self.positions_m.append(_with(self.positions_m[-1], self.running, positions))
        self.speeds_mps.append(_with(self.speeds_mps[-1], self.running, speeds))
        self._end()

    def _end(self) -> None:
        """Note which trials have ended by now, and go on with the others."""
        sample = len(self.positions_m) - 1
        positions = self.positions_m[-1][:, self.running]
        scenario = self.task.scenario
        status = np.full(self.running.size, RUNNING, "<U8")
        if sample >= round(scenario.timeout_s / TICK_S):
            status[:] = "timeout"
        status[positions.max(axis=0) >= self.task.track.end_m] = "finished"
        status[_collisions(self.task, positions)] = "collided"
        ended = status != RUNNING
        if ended.any():
            self.status[self.running] = status
            self.ended_at[self.running[ended]] = sample
            self.running = self.running[~ended]
            kept = np.concatenate([~ended, ~ended])
            self.agents = self.agents.keep(kept)
            self.accelerations, self.error = self.accelerations[kept], self.error[kept]

    def _vehicles(self) -> Vehicles:
        return Vehicles(
            self.positions_m[-1][:, self.running].ravel(),
            self.speeds_mps[-1][:, self.running].ravel(),
        )


def _noise(seed: int, seconds: float) -> Array:
    """Return the random draws of the runner's driver with this seed, of the shape (draws, 2)."""
    return np.random.default_rng(seed).standard_normal((round(seconds / TICK_S) + 1, 2))


def _others(vehicles: Vehicles) -> Vehicles:
    return Vehicles(_swapped(vehicles.positions_m), _swapped(vehicles.speeds_mps))


def _swapped(values: Array) -> Array:
    return np.roll(values, values.size // 2)


def _with(values: Array, chosen: NDArray[np.int64], changed: Array) -> Array:
    """Values of the shape (2, n), with other columns."""
    copy = values.copy()
    copy[:, chosen] = changed.reshape(2, -1)
    return copy


def _collisions(task: Task, positions_m: Array) -> Mask:
    """Return True for pairs of vehicles that collide by the scenario's rule; positions: (2, n)."""
    track, scenario = task.track, task.scenario
    # Centres farther apart than a diagonal never do; of the few others the world's rule is asked.
    before = np.maximum(track.merge_point_m - positions_m, 0.0)
    across = before.sum(axis=0) * track.branch_sine
    along = np.diff(positions_m + before * (1 - track.branch_cosine), axis=0)[0]
    reach = np.hypot(scenario.vehicle_length_m, scenario.vehicle_width_m)
    collide = across**2 + along**2 < reach**2
    for n in np.flatnonzero(collide):
        left, right = map(float, positions_m[:, n])
        collide[n] = collided(scenario, track, left, right)
    return np.asarray(collide)
