"""Overlap of the two vehicles' outlines in a trial: the collision rule of the human experiment."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from math import ceil, sqrt
from typing import NamedTuple

from merge_runner.config import ScenarioConfig
from merge_runner.scenarios.merge.collision import rectangles_overlap, squared_distance_m2
from merge_runner.scenarios.merge.geometry import TRACK
from merge_runner.scenarios.merge.vehicle import advance

# The rule of the human experiment is boxes that overlap, checked at this rate.
LOOKS_HZ = 20
# Step, time, and of the left and the right vehicle the travelled distance and the speed.
Sample = tuple[int, float, float, float, float, float]


class Overlap(NamedTuple):
    """An instant at which the outlines overlap, and how far the centres are apart."""

    time_s: float
    apart_m: float


def first_overlap(config: ScenarioConfig, samples: Sequence[Sample]) -> Overlap | None:
    """Return the first overlap at any sample, or at 20 Hz between samples of a step."""
    size = (config.vehicle_length_m, config.vehicle_width_m)
    for time_s, left_m, right_m in _looks(samples):
        if rectangles_overlap(TRACK, left_m, right_m, *size):
            return Overlap(time_s, sqrt(squared_distance_m2(TRACK, left_m, right_m)))
    return None


def _looks(samples: Sequence[Sample]) -> Iterator[tuple[float, float, float]]:
    """Yield time and both positions at every sample, and at 20 Hz within a step."""
    before: Sample | None = None
    for now in samples:
        if before is not None and now[0] == before[0] + 1:
            step_s = now[1] - before[1]
            looks = ceil(step_s * LOOKS_HZ - 1e-6)
            for part_s in (step_s * look / looks for look in range(1, looks)):
                left_m = _moved(before[2:4], now[2:4], step_s, part_s)
                yield before[1] + part_s, left_m, _moved(before[4:], now[4:], step_s, part_s)
        yield now[1], now[2], now[4]
        before = now


def _moved(
    before: tuple[float, float], now: tuple[float, float], step_s: float, part_s: float
) -> float:
    """Return a vehicle's position within a step of constant acceleration."""
    (before_m, before_mps), (now_m, now_mps) = before, now
    acceleration = (now_mps - before_mps) / step_s
    if now_mps <= 0 and now_m > before_m:  # it stopped the vehicle before the end of the step
        acceleration = before_mps**2 / (-2 * (now_m - before_m))
    return advance(before_m, before_mps, acceleration, part_s)[0]
