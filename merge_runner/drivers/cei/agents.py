"""Agents of the model as arrays, with one element for each agent.

An object with one element drives a vehicle of a trial; one with thousands simulates a study. Both
decide the same (Siebinga, Zgonnikov and Abbink 2024).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from merge_runner.drivers.cei.motion import Array, Mask, Task, course
from merge_runner.drivers.cei.parameters import (
    BROADER,
    CRUISE_GAIN,
    HIGHEST_THRESHOLD,
    LOWEST_THRESHOLD,
    MEMORY_TICKS,
    NODE_S,
    NODES,
    PLAN_NOISE,
    PLANS,
    TICK_S,
    TO_LOWER,
    TO_UPPER,
    Base,
    Habits,
    ThresholdSet,
)

AHEAD_S = NODE_S * np.arange(1, NODES + 1)
INPUTS = np.linspace(-1.0, 1.0, PLANS)
# Most plans that are too risky are so at many nodes: a few of these are tried first.
NODES_BY_TURNS = tuple(slice(first, None, 4) for first in (3, 1, 0, 2))
TURNS = 9
OFF = UNSOLVED = -1
SLOWEST_MPS = 0.1


@dataclass(frozen=True, slots=True)
class Model:
    """Task, thresholds and habits that all agents of a simulation share."""

    task: Task
    thresholds: ThresholdSet
    habits: Habits


@dataclass(frozen=True, slots=True)
class Vehicles:
    """Positions in m and speeds in m/s, one for each agent."""

    positions_m: Array
    speeds_mps: Array


@dataclass(frozen=True, slots=True)
class Belief:
    """Predicted positions of the other: normal distributions of the shape (nodes, agents), in m."""

    mean_m: Array
    spread_m: Array

    def of(self, nodes: slice, agents: NDArray[np.int64]) -> Belief:
        """Return the belief of these agents, repeats included, at these nodes."""
        return Belief(self.mean_m[nodes][:, agents], self.spread_m[nodes][:, agents])


@dataclass(slots=True)
class Agents:
    """State of the agents between two ticks.

    ``lower`` and ``upper`` are base thresholds, ``desired_mps`` is the speed of an agent alone.
    ``perceived_mps`` is the perceived speed of the other, ``memory_mps2`` holds the other's last 40
    accelerations. ``waited_ticks`` counts the ticks of low risk (OFF: the risk is not low).
    ``unsolved``: no plan was safe enough. ``inputs`` in [-1, 1] are driven.
    """

    lower: Array
    upper: Array
    desired_mps: Array
    perceived_mps: Array
    memory_mps2: Array
    waited_ticks: NDArray[np.int64]
    unsolved: Mask
    last_mps: Array
    inputs: Array

    def perceive(self, model: Model, other: Vehicles, other_mps2: Array, noise: Array) -> None:
        """Perceive the other for one tick; ``noise`` is standard normal, one number an agent."""
        remaining, wander = model.habits.remaining, model.habits.wander_mps
        self.perceived_mps = (
            other.speeds_mps + remaining * (self.perceived_mps - other.speeds_mps) + wander * noise
        )
        self.memory_mps2 = np.concatenate([self.memory_mps2[1:], other_mps2[None]])

    def decide(
        self,
        model: Model,
        ego: Vehicles,
        other: Vehicles,
        noise: Array,
        controls: Mask,
        ticks: int = 1,
    ) -> None:
        """Compute the risk, and replan where there is a reason.

        ``noise`` is standard normal, one number an agent; ``ticks`` have passed since the last
        call. Agents without ``controls`` are driven by their cruise control.
        """
        last_mps, self.last_mps = self.last_mps, ego.speeds_mps
        if not controls.any():
            return
        belief = self._belief(model, other)
        ahead = course(model.task, ego.positions_m, ego.speeds_mps, self.inputs)
        risk = risks(model.task, ahead.positions_m[1:], belief).max(axis=0)
        crossed = (last_mps - self.desired_mps) * (ego.speeds_mps - self.desired_mps) < 0
        thresholds = self._thresholds(model.thresholds, ego, other)
        bound = self._bound(model.habits, risk, thresholds, crossed, controls, ticks)
        replans = np.isfinite(bound)
        if replans.any():
            self._plan(model, ego, other, belief, bound, noise, replans)

    def keep(self, chosen: Mask) -> Agents:
        """Return the chosen agents."""
        kept = {field.name: getattr(self, field.name)[..., chosen] for field in fields(self)}
        return replace(self, **kept)

    def _belief(self, model: Model, other: Vehicles) -> Belief:
        mean = self.memory_mps2.mean(axis=0)
        spread = self.memory_mps2.std(axis=0) + model.habits.comfortable_mps2 / 3
        seconds = AHEAD_S[:, None]
        return Belief(
            other.positions_m + self.perceived_mps * seconds + mean * seconds**2 / 2,
            spread * seconds**2 / 2,
        )

    def _thresholds(self, of: ThresholdSet, ego: Vehicles, other: Vehicles) -> tuple[Array, Array]:
        headway = ego.positions_m - other.positions_m
        faster = ego.speeds_mps - self.perceived_mps
        lower = of.lower_headway * headway + of.lower_speed * faster
        upper = of.upper_headway * headway + of.upper_speed * faster
        product = headway * faster
        return (
            _clipped(self.lower + lower + of.lower_product * product),
            _clipped(self.upper + upper + of.upper_product * product),
        )

    def _bound(
        self,
        habits: Habits,
        risk: Array,
        thresholds: tuple[Array, Array],
        crossed: Mask,
        controls: Mask,
        ticks: int,
    ) -> Array:
        """Return the highest risk of a new plan, infinite where there is no reason to replan.

        The first reason counts: no safe plan before, a low risk for long, a high risk, the desired
        speed crossed.
        """
        lower, upper = thresholds
        low, waiting = risk < lower, self.waited_ticks != OFF
        waited = np.where(waiting, self.waited_ticks + ticks, np.where(low, 0, OFF))
        returns = low & (waited > habits.saturation_ticks) & ~self.unsolved
        bound = np.select(
            [~controls, self.unsolved, returns, risk > upper, crossed],
            [np.inf, TO_LOWER * lower, TO_UPPER * upper, TO_LOWER * lower, TO_UPPER * upper],
            np.inf,
        )
        ends = ~controls | np.isfinite(bound) | (risk > lower)
        self.waited_ticks = np.where(controls & returns, 0, np.where(ends, OFF, waited))
        return np.asarray(bound)

    def _plan(
        self,
        model: Model,
        ego: Vehicles,
        other: Vehicles,
        belief: Belief,
        bound: Array,
        noise: Array,
        replans: Mask,
    ) -> None:
        """Set the cheapest input within the bound; if none is, full power if ahead, else brakes."""
        agents = np.flatnonzero(replans)
        plans = course(model.task, ego.positions_m[agents], ego.speeds_mps[agents], INPUTS[:, None])
        best = cheapest_safe(
            model.task,
            plans.positions_m[1:],
            plans.cost(self.desired_mps[agents]),
            belief.of(slice(None), agents),
            bound[agents],
        )
        solved = best != UNSOLVED
        ahead = ego.positions_m[agents] > other.positions_m[agents]
        self.inputs, self.unsolved = self.inputs.copy(), self.unsolved.copy()
        self.inputs[agents] = np.where(
            solved, _driven(model, INPUTS[best], noise[agents]), np.where(ahead, 1.0, -1.0)
        )
        self.unsolved[agents] = ~solved


def start(
    model: Model,
    bases: Sequence[Base],
    ego: Vehicles,
    other: Vehicles,
    desired_mps: Array,
    ticks: Array,
    noise: Array,
) -> Agents:
    """Return agents that have cruised in the tunnel for ``ticks``.

    Their plan is to hold the speeds that they desire. They have perceived the other since the start
    of the run, when they assumed their own speed for it, so that the perceived speed is normally
    distributed. ``noise`` is standard normal, of the shape (agents, 2): for perception and plan.
    """
    habits = model.habits
    remaining = habits.remaining**ticks
    known = other.speeds_mps + remaining * (ego.speeds_mps - other.speeds_mps)
    wander = habits.wander_mps * np.sqrt((1 - remaining**2) / (1 - habits.remaining**2))
    hold = course(model.task, ego.positions_m, desired_mps, INPUTS[:, None])
    inputs = INPUTS[hold.cost(desired_mps).argmin(axis=0)]
    agents = len(ego.positions_m)
    return Agents(
        lower=np.array([base.lower for base in bases]),
        upper=np.array([base.upper for base in bases]),
        desired_mps=desired_mps,
        perceived_mps=known + wander * noise[:, 0],
        memory_mps2=np.zeros((MEMORY_TICKS, agents)),
        waited_ticks=np.full(agents, OFF),
        unsolved=np.zeros(agents, bool),
        last_mps=ego.speeds_mps,
        inputs=_driven(model, inputs, noise[:, 1]),
    )


def set_speeds(task: Task, speeds_mps: Array) -> Array:
    """Return the set speeds in m/s of cruise controls that hold these speeds under resistance."""
    resisted = task.net_mps2(np.zeros_like(speeds_mps), speeds_mps)
    return speeds_mps - resisted / (CRUISE_GAIN * task.scenario.max_acceleration_mps2)


def cheapest_safe(
    task: Task, positions_m: Array, cost: Array, belief: Belief, bound: Array
) -> NDArray[np.int64]:
    """Return the index of each agent's cheapest input whose risk stays within its bound.

    It is UNSOLVED where there is none. ``positions_m`` has the shape (nodes, inputs, agents),
    ``cost`` (inputs, agents). Cheap inputs are tried first; most agents need no others.
    """
    best = np.full(bound.size, UNSOLVED)
    ranks = cost.argsort(axis=0, kind="stable")
    left = np.arange(bound.size)
    for inputs in np.array_split(ranks, TURNS):
        safe = np.ones((len(inputs), left.size), bool)
        for nodes in NODES_BY_TURNS:
            rows, columns = np.nonzero(safe)
            agents = left[columns]
            ahead = positions_m[nodes][:, inputs[rows, agents], agents]
            risk = risks(task, ahead, belief.of(nodes, agents))
            safe[rows, columns] = (risk <= bound[agents]).all(axis=0)
        solved = safe.any(axis=0)
        best[left[solved]] = inputs[safe.argmax(axis=0)[solved], left[solved]]
        left = left[~solved]
        if not left.size:
            break
    return best


def tunnel_ticks(ego: Vehicles, other: Vehicles) -> Array:
    """Return the ticks since the vehicle farther back was at position 0, at present speeds.

    A perceived speed may be 0 by an error: SLOWEST_MPS then takes its place.
    """
    return np.asarray(np.minimum(_since_start_s(ego), _since_start_s(other)) / TICK_S)


def _since_start_s(vehicles: Vehicles) -> Array:
    return np.asarray(vehicles.positions_m / np.maximum(vehicles.speeds_mps, SLOWEST_MPS))


def risks(task: Task, positions_m: Array, belief: Belief) -> Array:
    """Return the risk of positions at the nodes of a belief, both of the shape (nodes, n).

    It is the mean of the probabilities of a collision and of being too close.
    """
    risk = np.zeros(positions_m.shape)
    near = positions_m >= task.interval.contact_m
    mean, spread = belief.mean_m[near], belief.spread_m[near]
    lower, upper = task.interval.at(positions_m[near])
    below, above = (lower - mean) / spread, (upper - mean) / spread
    close = ndtr(above / BROADER) - ndtr(below / BROADER)
    risk[near] = (ndtr(above) - ndtr(below) + close) / 2
    return risk


def _clipped(threshold: Array) -> Array:
    return np.clip(threshold, LOWEST_THRESHOLD, HIGHEST_THRESHOLD)


def _driven(model: Model, inputs: Array, noise: Array) -> Array:
    """Return plans with motor noise, which never lowers an input."""
    more = PLAN_NOISE * np.abs(noise) if model.habits.noise else 0.0
    return np.minimum(inputs + more, 1.0)
