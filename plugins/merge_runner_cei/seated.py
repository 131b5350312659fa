"""What one driver of the model has in mind during a trial: agents of which there is one."""

from __future__ import annotations

import numpy as np

from merge_runner.drivers.program_seat import ProgramSeat
from merge_runner.records import SIDES, Observation
from merge_runner.scenarios.merge.geometry import TRACK
from merge_runner_cei.agents import Model, Vehicles, set_speeds, start, tunnel_ticks
from merge_runner_cei.motion import Array, task_of
from merge_runner_cei.parameters import TICK_S, Habits, ThresholdSet, offsets_of


class Seated:
    """The driver of a seat, from its first observation on.

    A car out of sight poses no risk, FAR_BEHIND_M behind. Until it is in sight, the driver takes
    its speed to be the own one, as at the start of a run.
    """

    def __init__(self, seat: ProgramSeat, thresholds: ThresholdSet, seen: Observation) -> None:
        self._model = Model(task_of(seat.scenario, TRACK), thresholds, Habits())
        self._random = np.random.default_rng(seat.seed)
        own, other = _vehicles(seen)
        offsets = offsets_of(int(seat.number("pair")), seat.repetition)
        base = thresholds.base(offsets[SIDES.index(seat.side)])
        desired = set_speeds(self._model.task, own.speeds_mps)
        ticks = tunnel_ticks(own, other) if seen.other_seen else np.zeros(1)
        self._agents = start(self._model, [base], own, other, desired, ticks, self._noise())
        self._last = seen

    def decide(self, seen: Observation, ticks: int) -> float:
        """The input in [-1, 1] to hold, where ``ticks`` have passed since the last decision."""
        own, other = _vehicles(seen)
        accelerated = np.array([self._acceleration_mps2(seen, ticks)])
        noises = [self._noise() for _ in range(ticks)]
        for noise in noises:
            self._agents.perceive(self._model, other, accelerated, noise[:, 0])
        if not seen.other_seen:
            self._agents.perceived_mps = own.speeds_mps
        controls = np.ones(1, bool)
        self._agents.decide(self._model, own, other, noises[-1][:, 1], controls, ticks)
        self._last = seen
        return float(self._agents.inputs[0])

    def _acceleration_mps2(self, seen: Observation, ticks: int) -> float:
        """That of the other in each of these ticks."""
        if ticks == 1 or not (seen.other_seen and self._last.other_seen):
            return seen.other_acceleration_mps2
        # Between two decisions that are more than a tick apart it saw a steady change of speed.
        return (seen.other_speed_mps - self._last.other_speed_mps) / (ticks * TICK_S)

    def _noise(self) -> Array:
        return self._random.standard_normal((1, 2))


def _vehicles(seen: Observation) -> tuple[Vehicles, Vehicles]:
    """The own one and the other."""
    own_m, other_m = seen.own_position_m, seen.own_position_m + seen.relative_distance_m
    return (
        Vehicles(np.array([own_m]), np.array([seen.own_speed_mps])),
        Vehicles(np.array([other_m]), np.array([seen.other_speed_mps])),
    )
