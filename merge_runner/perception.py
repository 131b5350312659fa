"""Observation model of a driver: delay, noise, dropout and a limited range."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cache
from itertools import takewhile
from math import exp, inf, sqrt, tanh
from statistics import NormalDist

from merge_runner.chance import draw
from merge_runner.config import Perception
from merge_runner.records import FAR_BEHIND_M, Observation

TOP = 2**31
"""Duration of the error processes in ms; time 0 is in the middle."""


class NoisyObserver:
    """Noisy observer of one driver in one trial.

    ``true_observation`` returns the noise-free observation at a step of the world. ``seed`` comes
    from the driver's context: a slot has the same errors whoever drives.
    """

    def __init__(
        self,
        perception: Perception,
        seed: int,
        step_s: float,
        true_observation: Callable[[int], Observation],
    ) -> None:
        self._perception, self._seed, self._step_s = perception, seed, step_s
        self._distance, self._speed, self._own_distance, self._own_speed = (
            error_process((seed, f"error of {name}"), sd, perception.autocorrelation_s)
            for name, sd in (
                ("distance", perception.position_sd_m),
                ("speed", perception.speed_sd_mps),
                ("own distance", perception.position_sd_m * perception.own),
                ("own speed", perception.speed_sd_mps * perception.own),
            )
        )
        self._true_observation, start = true_observation, true_observation(0)
        self._received = replace(start, other_seen=self._in_sight(start))

    def observe(self, step: int) -> Observation:
        """Return the driver's observation at the current step."""
        now_s, truth = step * self._step_s, self._true_observation(step)
        if draw(self._seed, "received", round(1000 * now_s)) >= self._perception.dropout:
            self._received = self._perceived(now_s - self._perception.delay_s)
        own_speed_mps = max(0.0, truth.own_speed_mps + self._own_speed(now_s))
        farther_m = self._own_distance(now_s)
        to_merge_m = truth.distance_to_merge_m
        other = self._received
        if not other.other_seen:
            other = replace(
                other,
                other_speed_mps=own_speed_mps,
                relative_distance_m=-FAR_BEHIND_M,
                other_speeds_mps=(),
                other_acceleration_mps2=0.0,
            )
        return replace(
            other,
            road=truth.road,
            own_speed_mps=own_speed_mps,
            own_position_m=truth.own_position_m + farther_m,
            distance_to_merge_m=None if to_merge_m is None else to_merge_m - farther_m,
            own_accelerations_mps2=truth.own_accelerations_mps2,
        )

    def _perceived(self, time_s: float) -> Observation:
        """Return the other vehicle as observed at a time, with its speeds since it was in sight."""
        truth = self._at(time_s)
        newest_first = [
            (time_s - steps * self._step_s, speed)
            for steps, speed in enumerate(reversed(truth.other_speeds_mps), start=1)
        ]
        seen = takewhile(lambda sample: self._in_sight(self._at(sample[0])), newest_first)
        return replace(
            truth,
            other_seen=self._in_sight(truth),
            other_speed_mps=self._appears(truth.other_speed_mps, time_s),
            relative_distance_m=truth.relative_distance_m + self._distance(time_s),
            other_speeds_mps=tuple(self._appears(speed, then_s) for then_s, speed in seen)[::-1],
        )

    def _appears(self, speed_mps: float, time_s: float) -> float:
        # An error makes no speed negative: nobody drives backwards.
        return max(0.0, speed_mps + self._speed(time_s))

    def _in_sight(self, truth: Observation) -> bool:
        near = abs(truth.relative_distance_m) <= (self._perception.range_m or inf)
        to_merge_m = truth.distance_to_merge_m or 0.0
        return truth.other_seen and near and to_merge_m <= (self._perception.view_from_m or inf)

    def _at(self, time_s: float) -> Observation:
        """Return the true observation at a time; before the start of control both cruised."""
        step = round(time_s / self._step_s)
        if step >= 0:
            return self._true_observation(step)
        start = self._true_observation(0)
        ahead_m = (start.other_speed_mps - start.own_speed_mps) * time_s
        return replace(
            start,
            relative_distance_m=start.relative_distance_m + ahead_m,
            distance_to_merge_m=(start.distance_to_merge_m or 0.0) - start.own_speed_mps * time_s,
        )


def error_process(
    stream: tuple[object, ...], sd: float, autocorrelation_s: float
) -> Callable[[float], float]:
    """Return an Ornstein-Uhlenbeck process: Gaussian errors by time, exponentially autocorrelated.

    (Uhlenbeck and Ornstein, 1930.) The value at a time in s depends on the ``stream`` and on the
    time alone, to the millisecond: any steps in any order give the same process. It is built by
    bisection, as in Levy's construction of Brownian motion: the process is Markov, so that the
    value midway between two known ones, x from each, has the mean of their values divided by
    cosh(x / tau), and the variance sd^2 tanh(x / tau).
    """

    @cache
    def standard(place: int) -> float:
        uniform = draw(*stream, place)
        chance = NormalDist().inv_cdf(0.5 + (uniform - 0.5) * (1 - 2**-52))
        if place == 0:
            return chance
        distance = place & -place  # to the two neighbours that it bisects
        ratio = distance / (1000 * autocorrelation_s) if autocorrelation_s else inf
        if place == TOP:
            kept = exp(-ratio)
            return kept * standard(0) + sqrt(1 - kept**2) * chance
        variance = tanh(ratio)
        ends = standard(place - distance) + standard(place + distance)
        return ends / 2 * sqrt(1 - variance**2) + sqrt(variance) * chance

    return lambda time_s: sd * standard(TOP // 2 + round(1000 * time_s)) if sd else 0.0
