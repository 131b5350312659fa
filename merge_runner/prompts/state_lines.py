"""Additional state variables of a prompt beyond the paper's, in words if they are undefined.

They are computed from the driver's observation, at present speeds, and contain their unit.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

from merge_runner.records import Observation

NOT_SEEN = "not seen"
OTHER = "the other car"
STRAIGHT = "not defined on the straight road"
EQUAL_MPS = 0.05
# Smaller values are 0.00 in a prompt.
LEVEL_M = STANDING_MPS = 0.005


def projected_headway(seen: Observation) -> str:
    """Return which car is ahead, and by how far, when the first one reaches the merge point."""
    if not seen.other_seen:
        return NOT_SEEN
    own_m = seen.distance_to_merge_m
    if own_m is None:
        return STRAIGHT
    other_m = own_m - seen.relative_distance_m
    if own_m <= 0 or other_m <= 0:
        subject = "you have" if own_m <= 0 else f"{OTHER} has"
        return f"not defined, {subject} passed the merge point"
    own_mps, other_mps = seen.own_speed_mps, seen.other_speed_mps
    times = [m / mps for m, mps in ((own_m, own_mps), (other_m, other_mps)) if mps >= STANDING_MPS]
    if not times:
        return "not defined, both cars stand still"
    ahead_m = (own_mps - other_mps) * min(times) - seen.relative_distance_m
    return _who_is_ahead(ahead_m, f"{abs(ahead_m):.2f} m")


def own_time_to_merge(seen: Observation) -> str:
    """Return the time until the own car reaches the merge point."""
    if seen.distance_to_merge_m is None or seen.distance_to_merge_m <= 0:
        return "you have passed it"
    if seen.own_speed_mps < STANDING_MPS:
        return "never, you stand still"
    return f"{seen.distance_to_merge_m / seen.own_speed_mps:.2f} s"


def other_time_to_merge(seen: Observation) -> str:
    """Return the time until the other car reaches the merge point."""
    if not seen.other_seen:
        return NOT_SEEN
    if seen.distance_to_merge_m is None:
        return STRAIGHT
    distance_m = seen.distance_to_merge_m - seen.relative_distance_m
    if distance_m <= 0:
        return "it has passed it"
    if seen.other_speed_mps < STANDING_MPS:
        return "never, it stands still"
    return f"{distance_m / seen.other_speed_mps:.2f} s"


def time_gap(seen: Observation) -> str:
    """Return which car is ahead, and the time until the one behind reaches its present position."""
    if not seen.other_seen:
        return NOT_SEEN
    ahead_m = -seen.relative_distance_m
    speed_mps = seen.other_speed_mps if ahead_m >= 0 else seen.own_speed_mps
    if speed_mps < STANDING_MPS:
        return f"not defined, {f'{OTHER} stands' if ahead_m >= 0 else 'you stand'} still"
    return _who_is_ahead(ahead_m, f"{abs(ahead_m) / speed_mps:.2f} s")


def relative_speed(seen: Observation) -> str:
    """Return which car is faster, and by how much."""
    if not seen.other_seen:
        return NOT_SEEN
    faster_mps = seen.other_speed_mps - seen.own_speed_mps
    if abs(faster_mps) <= EQUAL_MPS + 1e-9:
        return f"{OTHER} is as fast as you"
    word = "faster" if faster_mps > 0 else "slower"
    return f"{OTHER} is {abs(faster_mps):.1f} m/s {word} than you"


def _who_is_ahead(ahead_m: float, by: str) -> str:
    if abs(ahead_m) < LEVEL_M:
        return "neither, both cars are level"
    return f"you are {by} ahead" if ahead_m > 0 else f"{OTHER} is {by} ahead"


LINES: Mapping[str, Callable[[Observation], str]] = {
    "projected_headway": projected_headway,
    "own_time_to_merge": own_time_to_merge,
    "other_time_to_merge": other_time_to_merge,
    "time_gap": time_gap,
    "relative_speed_in_words": relative_speed,
}
"""Template variables with a text as value."""
