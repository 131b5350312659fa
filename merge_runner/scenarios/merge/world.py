"""One trial's world: both vehicles, their trace, what each driver sees, and when it ends."""

from __future__ import annotations

from collections.abc import Mapping

from merge_runner.config import ScenarioConfig
from merge_runner.errors import UsageError
from merge_runner.records import SIDES, Observation, Side, StateRow, Status, other_side
from merge_runner.scenarios.merge.collision import collided
from merge_runner.scenarios.merge.conditions import Condition
from merge_runner.scenarios.merge.geometry import Track
from merge_runner.scenarios.merge.vehicle import advance, net_acceleration, time_to_reach

Starts = Mapping[Side, tuple[float, float]]
"""Travelled distance in m and speed in m/s by side."""


class World:
    """Two vehicles on the track, from the start of control to the end of the trial.

    ``status`` is None while the trial runs. Time 0 is the start of control. Sampled states are
    kept from step 0 on, in SI units. Raises UsageError for a condition in which a vehicle would
    be at the merge point before that.
    """

    def __init__(self, config: ScenarioConfig, condition: Condition, track: Track) -> None:
        exits = condition.exit_times_s(track)
        start = max(exits) if config.control_start == "both_exits" else min(exits)
        self._config, self._track = config, track
        self.step = 0
        self.status: Status | None = None
        self._merge_times: dict[Side, float] = {}
        self._positions = {
            side: [position]
            for side, position in zip(SIDES, condition.positions_m(start, track), strict=True)
        }
        self._velocities = {
            side: [speed] for side, speed in zip(SIDES, condition.speeds_mps, strict=True)
        }
        self._accelerations: dict[Side, list[float]] = {side: [0.0] for side in SIDES}
        if max(self._positions["left"][0], self._positions["right"][0]) >= track.merge_point_m:
            raise UsageError(
                f"{condition.described}: a vehicle is at the merge point before both are driven"
            )
        if self._collided():
            self.status = "collided"

    def start_at(self, starts: Starts) -> None:
        """Let the vehicles start elsewhere than the condition says, before the first step."""
        for side, (position, speed) in starts.items():
            self._positions[side], self._velocities[side] = [position], [speed]
        self.status = "collided" if self._collided() else None

    @property
    def time_s(self) -> float:
        """The time since the start of control."""
        return _time(self.step, self._config.step_s)

    def in_control(self, side: Side) -> bool:
        """Whether the vehicle has left its tunnel; until then it cruises by itself."""
        return self._positions[side][-1] > self._track.tunnel_exit_m - 1e-9

    def advance(self, actions: dict[Side, float | None]) -> None:
        """Drive one step with normalised actions in [-1, 1]; None lets a vehicle cruise."""
        config = self._config
        for side in SIDES:
            velocity = self._velocities[side][-1]
            action = actions[side]
            acceleration = (
                0.0
                if action is None
                else net_acceleration(
                    action * config.max_acceleration_mps2, velocity, config.resistance
                )
            )
            self._move(side, acceleration)
        self.step += 1
        self.status = self._end()

    def merged_first(self) -> Side | None:
        """Who reached the merge point first; None after a collision or if nobody did."""
        if self.status == "collided" or not self._merge_times:
            return None
        return min(self._merge_times, key=self._merge_times.__getitem__)

    def observe(self, side: Side) -> Observation:
        """What the driver of ``side`` sees now, itself as ego."""
        other = other_side(side)
        position = self._positions[side][-1]
        farthest_back = (
            position
            if self._config.straight_after == "own"
            else min(position, self._positions[other][-1])
        )
        straight = farthest_back >= self._track.merge_point_m
        return Observation(
            road="straight" if straight else "merge",
            own_speed_mps=self._velocities[side][-1],
            other_speed_mps=self._velocities[other][-1],
            relative_distance_m=self._positions[other][-1] - position,
            distance_to_merge_m=None if straight else self._track.merge_point_m - position,
            own_accelerations_mps2=self._history(self._accelerations[side][1:], 0.0),
            other_speeds_mps=self._history(
                self._velocities[other][:-1], self._velocities[other][0]
            ),
            own_position_m=position,
            other_acceleration_mps2=self._accelerations[other][-1],
        )

    def states(self) -> tuple[StateRow, ...]:
        """The trace, one row per vehicle and sample."""
        return tuple(
            StateRow(
                step=step,
                time_s=_time(step, self._config.step_s),
                side=side,
                position_m=self._positions[side][step],
                velocity_mps=self._velocities[side][step],
                acceleration_mps2=self._accelerations[side][step],
            )
            for step in range(self.step + 1)
            for side in SIDES
        )

    def _move(self, side: Side, acceleration: float) -> None:
        dt = self._config.step_s
        position, velocity = self._positions[side][-1], self._velocities[side][-1]
        new_position, new_velocity = advance(position, velocity, acceleration, dt)
        if position < self._track.merge_point_m <= new_position:
            reach = time_to_reach(self._track.merge_point_m - position, velocity, acceleration)
            self._merge_times[side] = self.time_s + reach
        self._positions[side].append(new_position)
        self._velocities[side].append(new_velocity)
        # Where the vehicle stopped within the step, what it executed is less than the command.
        stopped = velocity + acceleration * dt < 0
        self._accelerations[side].append(-velocity / dt if stopped else acceleration)

    def _end(self) -> Status | None:
        left, right = self._positions["left"][-1], self._positions["right"][-1]
        if self._collided():
            return "collided"
        if max(left, right) >= self._track.end_m:
            return "finished"
        return "timeout" if self.step >= self._config.timeout_steps else None

    def _collided(self) -> bool:
        left, right = self._positions["left"][-1], self._positions["right"][-1]
        return collided(self._config, self._track, left, right)

    def _history(self, samples: list[float], before: float) -> tuple[float, ...]:
        wanted = self._config.memory_samples
        recent = samples[-wanted:]
        if self._config.history_start == "cruise":
            return (before,) * (wanted - len(recent)) + tuple(recent)
        return tuple(recent)


def _time(step: int, step_s: float) -> float:
    """The time of a step, without the binary dust of a product like 3 * 0.2."""
    return round(step * step_s, 9)
