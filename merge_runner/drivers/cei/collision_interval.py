"""Interval of the other's positions that collide, as in the model: between two straight lines.

The published model replaces the exact table of overlapping boxes by linear regressions over it;
these are made anew here, from the same boxes that the rule ``rectangle`` compares.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import NDArray

from merge_runner.scenarios.merge.collision import rectangles_overlap
from merge_runner.scenarios.merge.geometry import Track

Array = NDArray[np.float64]
TABLE_STEP_M = 0.5
PRECISION_M = 1e-7


@dataclass(frozen=True, slots=True)
class CollisionInterval:
    """Positions of the other that overlap a vehicle at a position from ``contact_m`` on.

    Both bounds are lines, slope and intercept in m; the lower one is at least ``contact_m``.
    """

    contact_m: float
    lower: tuple[float, float]
    upper: tuple[float, float]

    def at(self, position_m: Array) -> tuple[Array, Array]:
        """Return the lower and the upper bound in m."""
        (low, low_m), (high, high_m) = self.lower, self.upper
        return np.maximum(self.contact_m, low * position_m + low_m), high * position_m + high_m


@cache
def collision_interval(track: Track, length_m: float, width_m: float) -> CollisionInterval:
    """Return the regression lines of the exact bounds, from first contact to the track's end."""
    contact = first_contact(track, length_m, width_m)
    positions = np.arange(contact + PRECISION_M, track.end_m, TABLE_STEP_M)
    bounds = [exact_bounds(track, length_m, width_m, float(p)) for p in positions]
    lower, upper = np.array(bounds).T
    after = lower > contact + 2 * PRECISION_M  # before, the other is at the contact itself
    # The published table has no positions beyond the track's end, which bends its upper line: near
    # the merge point the model is 0.1 to 0.3 m more careful than the boxes demand.
    upper = np.minimum(upper, track.end_m)
    return CollisionInterval(
        contact, _line(positions[after], lower[after]), _line(positions, upper)
    )


def first_contact(track: Track, length_m: float, width_m: float) -> float:
    """Return the position in m before which no vehicle can touch the other."""
    # Level vehicles are the first that can.
    return _edge(
        lambda p: rectangles_overlap(track, p, p, length_m, width_m),
        track.merge_point_m,
        track.tunnel_exit_m,
    )


def exact_bounds(
    track: Track, length_m: float, width_m: float, position_m: float
) -> tuple[float, float]:
    """Return the bounds of the other's positions that overlap a vehicle past the contact."""
    reach = 2 * (length_m + width_m)
    low, high = (
        _edge(
            lambda other: rectangles_overlap(track, position_m, other, length_m, width_m),
            position_m,
            position_m + direction * reach,
        )
        for direction in (-1, 1)
    )
    return low, high


def _edge(inside: Callable[[float], bool], within: float, beyond: float) -> float:
    """Return by bisection the edge of a condition that holds at ``within``, not at ``beyond``."""
    while abs(beyond - within) > PRECISION_M:
        middle = (within + beyond) / 2
        within, beyond = (middle, beyond) if inside(middle) else (within, middle)
    return within


def _line(x: Array, y: Array) -> tuple[float, float]:
    slope, intercept = np.polyfit(x, y, 1)
    return float(slope), float(intercept)
