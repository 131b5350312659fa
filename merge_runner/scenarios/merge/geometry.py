"""Inverse-Y track: two branches meet at the merge point and continue as one lane.

Positions are travelled distances s along a vehicle's branch. The sine of a branch's angle to the
centreline is half the distance of the two start points divided by the branch's length.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from math import sqrt

from merge_runner.records import Side


@dataclass(frozen=True)
class Track:
    """Dimensions of the track in m; the human experiment has the defaults.

    ``tunnel_exit_m``, ``merge_point_m`` and ``end_m`` are travelled distances. The measures in SQL
    have the same numbers (measures.sql).
    """

    tunnel_exit_m: float = 50.0
    merge_point_m: float = 100.0
    end_m: float = 150.0
    start_distance_m: float = 25.0

    @cached_property
    def branch_sine(self) -> float:
        """Lateral distance of a branch per metre."""
        return self.start_distance_m / 2 / self.merge_point_m

    @cached_property
    def branch_cosine(self) -> float:
        """Distance of a branch along the centreline per metre."""
        return sqrt(1 - self.branch_sine**2)

    @cached_property
    def merge_y_m(self) -> float:
        """Position of the merge point along the centreline."""
        return self.merge_point_m * self.branch_cosine

    @cached_property
    def end_y_m(self) -> float:
        """Position of the track's end along the centreline."""
        return self.merge_y_m + self.end_m - self.merge_point_m

    def place(self, side: Side, position_m: float) -> tuple[float, float]:
        """Return the centre (x, y) of a vehicle in m; x is negative on the left branch."""
        if position_m >= self.merge_point_m:
            return 0.0, self.merge_y_m + position_m - self.merge_point_m
        offset = (self.merge_point_m - position_m) * self.branch_sine
        return (-offset if side == "left" else offset), position_m * self.branch_cosine

    def heading(self, side: Side, position_m: float) -> tuple[float, float]:
        """Return the unit vector of travel at a position."""
        if position_m > self.merge_point_m:
            return 0.0, 1.0
        return (self.branch_sine if side == "left" else -self.branch_sine), self.branch_cosine


TRACK = Track()
"""Track of the human experiment."""
