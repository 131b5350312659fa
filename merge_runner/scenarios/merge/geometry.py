"""The inverse-Y track: two branches meet at the merge point, and one lane follows.

Positions are travelled distances s along the own branch. The start points lie apart, so that a
branch leaves the centreline at the angle whose sine is half their distance over its length.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from math import sqrt

from merge_runner.records import Side


@dataclass(frozen=True)
class Track:
    """Where a run leads, in m; the defaults are the human experiment's.

    ``tunnel_exit_m``, ``merge_point_m`` and ``end_m`` are travelled distances. The measures in SQL
    know no other numbers (measures.sql).
    """

    tunnel_exit_m: float = 50.0
    merge_point_m: float = 100.0
    end_m: float = 150.0
    start_distance_m: float = 25.0

    @cached_property
    def branch_sine(self) -> float:
        """How far a branch leads across the centreline, by metre."""
        return self.start_distance_m / 2 / self.merge_point_m

    @cached_property
    def branch_cosine(self) -> float:
        """How far a branch leads along the centreline, by metre."""
        return sqrt(1 - self.branch_sine**2)

    @cached_property
    def merge_y_m(self) -> float:
        """How far along the centreline the merge point is."""
        return self.merge_point_m * self.branch_cosine

    @cached_property
    def end_y_m(self) -> float:
        """How far along the centreline the track ends."""
        return self.merge_y_m + self.end_m - self.merge_point_m

    def place(self, side: Side, position_m: float) -> tuple[float, float]:
        """The point (x, y) in m of a vehicle's centre; x is negative on the left branch."""
        if position_m >= self.merge_point_m:
            return 0.0, self.merge_y_m + position_m - self.merge_point_m
        offset = (self.merge_point_m - position_m) * self.branch_sine
        return (-offset if side == "left" else offset), position_m * self.branch_cosine

    def heading(self, side: Side, position_m: float) -> tuple[float, float]:
        """The unit vector of travel at a position."""
        if position_m > self.merge_point_m:
            return 0.0, 1.0
        return (self.branch_sine if side == "left" else -self.branch_sine), self.branch_cosine


TRACK = Track()
"""The human experiment's."""
