"""World of one trial: both vehicles with their trace, observations, and the end of the trial."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from merge_runner.config import ScenarioConfig
from merge_runner.errors import UsageError
from merge_runner.records import SIDES, Observation, Side
from merge_runner.scenarios.merge.collision import collided
from merge_runner.scenarios.merge.conditions import Condition
from merge_runner.scenarios.merge.geometry import Track
from merge_runner.scenarios.merge.vehicle import Vehicle
from merge_runner.trial_records import StateRow, Status


class World:
    """Two vehicles on the track, from the start of control to the end of the trial.

    ``status`` is None while the trial runs. Time 0 is the start of control. ``starts`` (in m and
    m/s) replace the start of the condition. Raises UsageError if a vehicle of the condition is at
    the merge point before control starts.
    """

    def __init__(
        self,
        config: ScenarioConfig,
        condition: Condition,
        track: Track,
        starts: Mapping[Side, tuple[float, float]] | None = None,
    ) -> None:
        exits = condition.exit_times_s(track)
        start_s = max(exits) if config.control_start == "both_exits" else min(exits)
        positions = condition.positions_m(start_s, track)
        places = zip(SIDES, zip(positions, condition.speeds_mps, strict=True), strict=True)
        self._config, self._track = config, track
        self.step = 0
        self._vehicles = {
            side: Vehicle([position], [speed])
            for side, (position, speed) in (starts or dict(places)).items()
        }
        if max(positions) >= track.merge_point_m:
            raise UsageError(f"{condition}: a vehicle is at the merge point before both are driven")
        at = [self._vehicles[side].positions[0] for side in SIDES]
        together = collided(config, track, *at)
        self.status: Status | None = "collided" if together else None

    @property
    def time_s(self) -> float:
        """Time since the start of control."""
        return _time(self.step, self._config.step_s)

    def in_control(self, side: Side) -> bool:
        """Return whether the vehicle has left its tunnel; until then it cruises by itself."""
        return self._vehicles[side].positions[-1] > self._track.tunnel_exit_m - 1e-9

    def drive(self, left: Sequence[float | None], right: Sequence[float | None]) -> None:
        """Drive some steps with normalised actions in [-1, 1], or until the trial ends.

        None lets a vehicle cruise.
        """
        config, track, vehicles = self._config, self._track, self._vehicles
        places = (
            vehicles["left"].drive(left, config, track.merge_point_m),
            vehicles["right"].drive(right, config, track.merge_point_m),
        )
        for left_m, right_m in zip(*places, strict=True):
            self.step += 1
            if collided(config, track, left_m, right_m):
                self.status = "collided"
            elif left_m >= track.end_m or right_m >= track.end_m:
                self.status = "finished"
            elif self.step >= config.timeout_steps:
                self.status = "timeout"
            if self.status is not None:
                return  # samples beyond this step are not part of the trial

    def merged_first(self) -> Side | None:
        """Return the side that reached the merge point first; None for neither or a collision."""
        merged = {side: vehicle.merged for side, vehicle in self._vehicles.items()}
        step_s = self._config.step_s
        times = {s: _time(at, step_s) + on for s, (at, on) in merged.items() if at < self.step}
        if self.status == "collided" or not times:
            return None
        return min(times, key=times.__getitem__)

    def observe(self, side: Side, step: int | None = None) -> Observation:
        """Return the true observation of the driver of ``side``, now or at an earlier step."""
        ego, other = self._vehicles["left"], self._vehicles["right"]
        if side == "right":
            ego, other = other, ego
        now = self.step if step is None else step
        position, other_position = ego.positions[now], other.positions[now]
        by_own = self._config.straight_after == "own"
        farthest_back = position if by_own else min(position, other_position)
        straight = farthest_back >= self._track.merge_point_m
        return Observation(
            road="straight" if straight else "merge",
            own_speed_mps=ego.velocities[now],
            other_speed_mps=other.velocities[now],
            relative_distance_m=other_position - position,
            distance_to_merge_m=None if straight else self._track.merge_point_m - position,
            own_accelerations_mps2=self._history(ego.accelerations[1 : now + 1], 0.0),
            other_speeds_mps=self._history(other.velocities[:now], other.velocities[0]),
            own_position_m=position,
            other_acceleration_mps2=other.accelerations[now],
        )

    def states(self) -> tuple[StateRow, ...]:
        """Return the trace as one row per vehicle and sample."""
        times_s = [_time(step, self._config.step_s) for step in range(self.step + 1)]
        columns = {
            side: (v.positions, v.velocities, v.accelerations) for side, v in self._vehicles.items()
        }
        rows = [
            StateRow(step, time_s, side, positions[step], velocities[step], accelerations[step])
            for step, time_s in enumerate(times_s)
            for side, (positions, velocities, accelerations) in columns.items()
        ]
        return tuple(rows)

    def _history(self, samples: list[float], before: float) -> tuple[float, ...]:
        length = self._config.memory_samples
        missing = length - len(samples) if self._config.history_start == "cruise" else 0
        return (before,) * missing + tuple(samples[-length:])


def _time(step: float, step_s: float) -> float:
    """Return the time of a step, rounded: 3 * 0.2 is not 0.6 in binary."""
    return round(step * step_s, 9)
