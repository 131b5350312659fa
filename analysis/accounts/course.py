"""How two vehicles drove, and what would have become of it had one of them done otherwise.

The vehicle that does otherwise is moved and judged by the world's own rules; the other one drives
as it drove, and keeps its speed from where its samples end.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from math import inf

from merge_runner.config import ScenarioConfig
from merge_runner.records import Side, other_side
from merge_runner.scenarios.merge.collision import collided
from merge_runner.scenarios.merge.geometry import Track
from merge_runner.scenarios.merge.vehicle import advance, net_acceleration

BRAKING, SPEEDING_UP = -1.0, 1.0
"""The hardest actions, as a plan normalises them."""
# Halved so often, the strongest action is known to 0.01 m/s^2.
BISECTIONS = 8
# Two clocks agree to this many seconds.
TICK_S = 1e-6


@dataclass(frozen=True, slots=True)
class Course:
    """Both vehicles from the start of control on, in SI units, one value a sample.

    Positions are travelled distances.
    """

    scenario: ScenarioConfig
    track: Track
    times_s: list[float]
    positions_m: dict[Side, list[float]]
    speeds_mps: dict[Side, list[float]]

    @property
    def last(self) -> int:
        """The number of the last sample."""
        return len(self.times_s) - 1

    def change_mps(self, side: Side, sample: int) -> float:
        """How much faster a vehicle is than it was at the start of control."""
        return self.speeds_mps[side][sample] - self.speeds_mps[side][0]

    def arrival_s(self, side: Side) -> float:
        """When a vehicle would be at the merge point if it kept its initial speed.

        inf: not before a trial is timed out.
        """
        start_s, speed_mps = self.times_s[0], self.speeds_mps[side][0]
        distance_m = self.track.merge_point_m - self.positions_m[side][0]
        if distance_m >= speed_mps * (self.scenario.timeout_s - start_s):
            return inf
        return start_s + distance_m / speed_mps

    def avoided(self, side: Side, action: float, since: int) -> bool:
        """Whether there is no collision if a side drives one action from a sample on."""
        scenario, commanded_mps2 = self.scenario, action * self.scenario.max_acceleration_mps2
        own_m, speed = self.positions_m[side][since], self.speeds_mps[side][since]
        for other_m in self._onward(other_side(side), since):
            net_mps2 = net_acceleration(commanded_mps2, speed, scenario.resistance)
            own_m, speed = advance(own_m, speed, net_mps2, scenario.step_s)
            left_m, right_m = (own_m, other_m) if side == "left" else (other_m, own_m)
            if collided(scenario, self.track, left_m, right_m):
                return False
            if max(left_m, right_m) >= self.track.end_m:
                break
        return True

    def last_chance(self, side: Side, action: float, after: int = -1) -> int | None:
        """The last sample from which the hardest action of a side still avoids the collision.

        Of two moments the earlier one is always the better to begin at. None where no sample
        ``after`` a given one will do.
        """
        low = max(after + 1, self._begin(side))
        if low >= self.last or not self.avoided(side, action, low):
            return None
        high = self.last  # where they have collided
        while high - low > 1:
            middle = (low + high) // 2
            low, high = (middle, high) if self.avoided(side, action, middle) else (low, middle)
        return low

    def least_mps2(self, side: Side, action: float, since: int) -> float:
        """The least strength that avoids the collision from a sample at which the hardest does."""
        if self.avoided(side, 0.0, since):
            return 0.0
        enough = _least(lambda share: self.avoided(side, action * share, since))
        return enough * self.scenario.max_acceleration_mps2

    def _begin(self, side: Side) -> int:
        """The first sample at which the driver of a side has control."""
        exit_m = self.track.tunnel_exit_m - TICK_S
        positions = self.positions_m[side]
        return next((i for i, at_m in enumerate(positions) if at_m > exit_m), self.last)

    def _onward(self, side: Side, since: int) -> Iterator[float]:
        """The positions of a vehicle after a sample, until a trial would be timed out."""
        positions, speed = self.positions_m[side], self.speeds_mps[side][-1]
        yield from positions[since + 1 :]
        position = positions[-1]
        for _ in range(self.last, self.scenario.timeout_steps):
            position, speed = advance(position, speed, 0.0, self.scenario.step_s)
            yield position


def _least(enough: Callable[[float], bool]) -> float:
    """The least share of 1 that is enough, where 1 is and 0 is not."""
    low, high = 0.0, 1.0
    for _ in range(BISECTIONS):
        middle = (low + high) / 2
        low, high = (low, middle) if enough(middle) else (middle, high)
    return high
