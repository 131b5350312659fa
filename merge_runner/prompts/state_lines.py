"""What a prompt may say of the state beyond the paper's numbers, in words where it has no value.

All is computed from what the driver is told, at present speeds, and has its unit in it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

from merge_runner.records import Observation

NOT_SEEN = "not seen"
OTHER = "the other car"
STRAIGHT = "not defined on the straight road"
EQUAL_MPS = 0.05
# What is smaller is 0.00 in a prompt.
LEVEL_M = STANDING_MPS = 0.005


def projected_headway(seen: Observation) -> str:
    """Which car is ahead, and how far, when the first of them reaches the merge point."""
    if not seen.other_seen:
        return NOT_SEEN
    own_m = seen.distance_to_merge_m
    if own_m is None:
        return STRAIGHT
    other_m = own_m - seen.relative_distance_m
    if own_m <= 0 or other_m <= 0:
        who = "you have" if own_m <= 0 else f"{OTHER} has"
        return f"not defined, {who} passed the merge point"
    own_mps, other_mps = seen.own_speed_mps, seen.other_speed_mps
    times = [m / mps for m, mps in ((own_m, own_mps), (other_m, other_mps)) if mps >= STANDING_MPS]
    if not times:
        return "not defined, both cars stand still"
    ahead_m = (own_mps - other_mps) * min(times) - seen.relative_distance_m
    return _who_is_ahead(ahead_m, f"{abs(ahead_m):.2f} m")


def own_time_to_merge(seen: Observation) -> str:
    """The time until the own car reaches the merge point."""
    if seen.distance_to_merge_m is None or seen.distance_to_merge_m <= 0:
        return "you have passed it"
    if seen.own_speed_mps < STANDING_MPS:
        return "never, you stand still"
    return f"{seen.distance_to_merge_m / seen.own_speed_mps:.2f} s"


def other_time_to_merge(seen: Observation) -> str:
    """The time until the other car reaches the merge point."""
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
    """Which car is ahead, and how long the one behind takes to where that is now."""
    if not seen.other_seen:
        return NOT_SEEN
    ahead_m = -seen.relative_distance_m
    speed_mps = seen.other_speed_mps if ahead_m >= 0 else seen.own_speed_mps
    if speed_mps < STANDING_MPS:
        return f"not defined, {f'{OTHER} stands' if ahead_m >= 0 else 'you stand'} still"
    return _who_is_ahead(ahead_m, f"{abs(ahead_m) / speed_mps:.2f} s")


def relative_speed(seen: Observation) -> str:
    """Which car is faster, and by how much."""
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
"""The fields of templates that are words."""
