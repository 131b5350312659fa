"""The program ``projected-order``: first come, first served, by projected arrival."""

from __future__ import annotations

from dataclasses import dataclass

from merge_runner.drivers.base import DriverContext
from merge_runner.drivers.registry import PROGRAMS, Program
from merge_runner.records import Decision, Observation

# The mean human gap at the merge point (arXiv 2604.09609, Table V).
TARGET_GAP_M = 3.85
HARDEST_BRAKING_MPS2 = -1.5
TIE_S = 1e-6


@dataclass(frozen=True, slots=True)
class ProjectedOrderDriver:
    """Driver that yields if the other is projected to arrive first; on a tie the right one yields.

    The yielding vehicle brakes evenly, at most 1.5 m/s^2, for a net gap of 3.85 m when the other
    reaches the merge point, and then follows at that gap.
    """

    context: DriverContext

    async def decide(self, observation: Observation, number: int) -> Decision:
        """Keep speed, open a gap, or follow."""
        action = self._acceleration(observation) / self.context.scenario.max_acceleration_mps2
        return self.context.held(min(1.0, max(-1.0, action)))

    def _acceleration(self, seen: Observation) -> float:
        distance = seen.distance_to_merge_m
        other_distance = None if distance is None else distance - seen.relative_distance_m
        if distance is None or other_distance is None or other_distance <= 0:
            return self._follow(seen) if seen.relative_distance_m > 0 else 0.0
        if self._goes_first(seen, distance, other_distance):
            return 0.0
        seconds = other_distance / max(seen.other_speed_mps, 0.1)
        spare = distance - seen.own_speed_mps * seconds
        distance_m = TARGET_GAP_M + self.context.scenario.vehicle_length_m
        return min(0.0, max(HARDEST_BRAKING_MPS2, 2 * (spare - distance_m) / seconds**2))

    def _goes_first(self, seen: Observation, distance: float, other_distance: float) -> bool:
        own_s = distance / max(seen.own_speed_mps, 0.1)
        other_s = other_distance / max(seen.other_speed_mps, 0.1)
        return own_s < other_s - TIE_S or (
            abs(own_s - other_s) <= TIE_S and self.context.side == "left"
        )

    def _follow(self, seen: Observation) -> float:
        """Return the acceleration that closes the speed difference in 1 s and the gap's in 4 s."""
        gap = seen.relative_distance_m - self.context.scenario.vehicle_length_m
        closing = seen.own_speed_mps - seen.other_speed_mps
        return -closing + (min(gap, TARGET_GAP_M) - TARGET_GAP_M) / 4


PROGRAMS.register(
    "projected-order",
    Program(
        ProjectedOrderDriver,
        "the driver projected to arrive first keeps its speed, the other yields",
        {"target_gap_m": TARGET_GAP_M, "hardest_braking_mps2": HARDEST_BRAKING_MPS2},
    ),
)
