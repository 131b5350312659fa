"""The inverse-Y track: two branches of 100 m meet at the merge point, 50 m of lane follow.

Positions are travelled distances s along the own branch. The start points are 25 m apart, so a
branch leaves the centreline at the angle whose sine is 12.5 / 100.
"""

from __future__ import annotations

from math import sqrt

from merge_runner.records import Side

TUNNEL_EXIT_M = 50.0
MERGE_POINT_M = 100.0
TRACK_END_M = 150.0
START_DISTANCE_M = 25.0

LATERAL = START_DISTANCE_M / 2 / MERGE_POINT_M
FORWARD = sqrt(1 - LATERAL**2)
MERGE_Y_M = MERGE_POINT_M * FORWARD


def place(side: Side, position_m: float) -> tuple[float, float]:
    """The point (x, y) in m of a vehicle's centre; x is negative on the left branch."""
    if position_m >= MERGE_POINT_M:
        return 0.0, MERGE_Y_M + position_m - MERGE_POINT_M
    offset = (MERGE_POINT_M - position_m) * LATERAL
    return (-offset if side == "left" else offset), position_m * FORWARD


def heading(side: Side, position_m: float) -> tuple[float, float]:
    """The unit vector of travel at a position."""
    if position_m > MERGE_POINT_M:
        return 0.0, 1.0
    return (LATERAL if side == "left" else -LATERAL), FORWARD
