"""Collision rules: three readings of one sentence of the paper.

arXiv 2604.09609 defines a collision by a "centre-to-centre distance" below a vehicle length. The
distance along the road cannot be meant: in 7 of the 11 conditions the vehicles are closer than that
when the drivers take control.
"""

from __future__ import annotations

from merge_runner.config import ScenarioConfig
from merge_runner.scenarios.merge.geometry import Track

Vector = tuple[float, float]


def collided(config: ScenarioConfig, track: Track, left_m: float, right_m: float) -> bool:
    """Return whether vehicles at these travelled distances collide under the scenario's rule."""
    length = config.vehicle_length_m
    # The paper's words, in the plane; squared, since no root is needed.
    if config.collision_rule == "euclid2d":
        return squared_distance_m2(track, left_m, right_m) < length**2
    # Along the road, once one vehicle is on the common lane.
    if config.collision_rule == "shared_lane":
        return max(left_m, right_m) >= track.merge_point_m and abs(left_m - right_m) < length
    # The rule of the human simulator (Siebinga et al., tud-hri/simple-merging-experiment).
    return rectangles_overlap(track, left_m, right_m, length, config.vehicle_width_m)


def squared_distance_m2(track: Track, left_m: float, right_m: float) -> float:
    """Return the squared distance between the two centres in the plane."""
    x_left, y_left = track.place("left", left_m)
    x_right, y_right = track.place("right", right_m)
    return (x_left - x_right) ** 2 + (y_left - y_right) ** 2


def rectangles_overlap(
    track: Track, left_m: float, right_m: float, length_m: float, width_m: float
) -> bool:
    """Return whether the two oriented vehicle boxes overlap.

    By the separating axis theorem (Gottschalk, Lin and Manocha 1996): two boxes are disjoint if and
    only if their projections onto one of their four axes are.
    """
    x_left, y_left = track.place("left", left_m)
    x_right, y_right = track.place("right", right_m)
    apart = (x_right - x_left, y_right - y_left)
    ahead_left, ahead_right = track.heading("left", left_m), track.heading("right", right_m)
    for ahead in (ahead_left, ahead_right):
        for axis in (ahead, (ahead[1], -ahead[0])):
            reach = _half_extent(ahead_left, axis, length_m, width_m) + _half_extent(
                ahead_right, axis, length_m, width_m
            )
            if abs(_dot(apart, axis)) >= reach:
                return False
    return True


def _half_extent(ahead: Vector, axis: Vector, length_m: float, width_m: float) -> float:
    """Return half the length of a box's projection onto an axis."""
    across = (ahead[1], -ahead[0])
    return abs(_dot(ahead, axis)) * length_m / 2 + abs(_dot(across, axis)) * width_m / 2


def _dot(a: Vector, b: Vector) -> float:
    return a[0] * b[0] + a[1] * b[1]
