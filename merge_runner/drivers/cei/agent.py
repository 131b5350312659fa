"""One driver of the CEI model in a trial, as a vector of one agent."""

from __future__ import annotations

import numpy as np

from merge_runner.drivers.base import DriverContext
from merge_runner.drivers.cei.agents import Model, Vehicles, set_speeds, start, tunnel_ticks
from merge_runner.drivers.cei.motion import Array, task_of
from merge_runner.drivers.cei.parameters import TICK_S, Habits, ThresholdSet, offsets_of
from merge_runner.records import SIDES, Observation
from merge_runner.scenarios.merge.geometry import TRACK


class Agent:
    """Driver of one side of a trial, from its first observation on.

    A vehicle out of sight poses no risk, FAR_BEHIND_M behind. Until it is in sight, the driver
    assumes its own speed for it, as at the start of a trial.
    """

    def __init__(self, context: DriverContext, thresholds: ThresholdSet, seen: Observation) -> None:
        self._model = Model(task_of(context.scenario, TRACK), thresholds, Habits())
        self._random = np.random.default_rng(context.seed)
        ego, other = _vehicles(seen)
        offsets = offsets_of(int(context.number("pair")), context.repetition)
        base = thresholds.base(offsets[SIDES.index(context.side)])
        desired = set_speeds(self._model.task, ego.speeds_mps)
        ticks = tunnel_ticks(ego, other) if seen.other_seen else np.zeros(1)
        self._agents = start(self._model, [base], ego, other, desired, ticks, self._noise())
        self._last = seen

    def decide(self, seen: Observation, ticks: int) -> float:
        """Return the input in [-1, 1] to hold; ``ticks`` have passed since the last decision."""
        ego, other = _vehicles(seen)
        accelerated = np.array([self._acceleration_mps2(seen, ticks)])
        noises = [self._noise() for _ in range(ticks)]
        for noise in noises:
            self._agents.perceive(self._model, other, accelerated, noise[:, 0])
        if not seen.other_seen:
            self._agents.perceived_mps = ego.speeds_mps
        controls = np.ones(1, bool)
        self._agents.decide(self._model, ego, other, noises[-1][:, 1], controls, ticks)
        self._last = seen
        return float(self._agents.inputs[0])

    def _acceleration_mps2(self, seen: Observation, ticks: int) -> float:
        if ticks == 1 or not (seen.other_seen and self._last.other_seen):
            return seen.other_acceleration_mps2
        # Between decisions that are several ticks apart its speed is taken to change steadily.
        return (seen.other_speed_mps - self._last.other_speed_mps) / (ticks * TICK_S)

    def _noise(self) -> Array:
        return self._random.standard_normal((1, 2))


def _vehicles(seen: Observation) -> tuple[Vehicles, Vehicles]:
    own_m, other_m = seen.own_position_m, seen.own_position_m + seen.relative_distance_m
    return (
        Vehicles(np.array([own_m]), np.array([seen.own_speed_mps])),
        Vehicles(np.array([other_m]), np.array([seen.other_speed_mps])),
    )
