"""The inverse-Y track: two branches meet at the merge point, and one lane follows.

Positions are travelled distances s along the own branch. The start points lie apart, so that a
branch leaves the centreline at the angle whose sine is half their distance over its length.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from functools import cached_property
from math import sqrt
from typing import Any

from merge_runner.errors import UsageError
from merge_runner.records import Side


@dataclass(frozen=True)
class Track:
    """Where a run leads, in m; the defaults are the human experiment's.

    ``tunnel_exit_m``, ``merge_point_m`` and ``end_m`` are travelled distances. The measures in SQL
    know no other numbers (measures.sql), and a spec holds those of every scenario but ``merge``.
    """

    tunnel_exit_m: float = 50.0
    merge_point_m: float = 100.0
    end_m: float = 150.0
    start_distance_m: float = 25.0

    def __post_init__(self) -> None:
        if not 0 <= self.tunnel_exit_m < self.merge_point_m < self.end_m < float("inf"):
            raise ValueError("a track leads from its tunnels to the merge point and to its end")
        if not 0 < self.start_distance_m < 2 * self.merge_point_m:
            raise ValueError("the start points of a track are less than both branches apart")

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


def track_of(spec: Mapping[str, Any]) -> Track:
    """The track of a stored spec, the human experiment's where it tells none.

    Raises UsageError, which names the field that is odd.
    """
    if "track" not in spec:
        return TRACK
    told = spec["track"] if isinstance(spec["track"], dict) else {}
    names = [field.name for field in fields(Track)]
    for name in (*names, *told):
        number = told.get(name)
        if name not in names or isinstance(number, bool) or not isinstance(number, int | float):
            raise UsageError(
                f"a stored spec has no track: track.{name} is {number!r}, and its numbers are "
                + ", ".join(names)
            )
    try:
        return Track(**{name: float(number) for name, number in told.items()})
    except (ValueError, OverflowError) as exc:
        raise UsageError(f"a stored spec has no track: {exc}") from exc
