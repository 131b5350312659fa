"""Kinematic conditions: the 11 of the human experiment, and registered ones."""

from __future__ import annotations

import re
from contextlib import suppress
from dataclasses import dataclass
from decimal import Decimal
from math import isfinite
from typing import ClassVar

from pydantic import ConfigDict

from merge_runner.config import Rate
from merge_runner.errors import UsageError
from merge_runner.registry import Registry
from merge_runner.scenarios.merge.geometry import Track

MEAN_SPEED_MPS = 10.0
"""Mean speed of every condition of the human experiment."""


@dataclass(frozen=True)
class Condition:
    """Initial condition of two vehicles; relative values are left minus right.

    ``projected_headway_m`` is the lead of the left vehicle at constant speeds when the first one is
    at the merge point. ``mean_speed_mps`` is the mean of both initial speeds. Raises UsageError
    unless both vehicles drive forwards.
    """

    __pydantic_config__: ClassVar = ConfigDict(extra="forbid")  # in a study file

    projected_headway_m: float
    relative_velocity_mps: float
    mean_speed_mps: Rate = MEAN_SPEED_MPS

    def __post_init__(self) -> None:
        if not isfinite(self.projected_headway_m) or not all(v > 0 for v in self.speeds_mps):
            raise UsageError(f"{self} is no condition: both vehicles must drive forwards")

    @property
    def speeds_mps(self) -> tuple[float, float]:
        """Initial speeds (left, right)."""
        half = self.relative_velocity_mps / 2
        return self.mean_speed_mps + half, self.mean_speed_mps - half

    def starts_m(self, track: Track) -> tuple[float, float]:
        """Return the travelled distances (left, right) at the start of the run, in the tunnels.

        With the projected leader at the merge point and the other |h| behind, both are moved
        backwards at constant speed until one of them is at 0.
        """
        speed_left, speed_right = self.speeds_mps
        left = track.merge_point_m + min(self.projected_headway_m, 0.0)
        right = track.merge_point_m - max(self.projected_headway_m, 0.0)
        seconds = min(left / speed_left, right / speed_right)
        return left - speed_left * seconds, right - speed_right * seconds

    def exit_times_s(self, track: Track) -> tuple[float, float]:
        """Return the times (left, right) of the tunnel exits at constant speed from the start."""
        # In closed form: steps of 0.2 s would overshoot an exit by up to 2 m.
        (left_m, right_m), (speed_left, speed_right) = self.starts_m(track), self.speeds_mps
        exit_m = track.tunnel_exit_m
        return (exit_m - left_m) / speed_left, (exit_m - right_m) / speed_right

    def positions_m(self, time_s: float, track: Track) -> tuple[float, float]:
        """Return the distances (left, right) at constant speed, ``time_s`` after the start."""
        (left_m, right_m), speeds = self.starts_m(track), self.speeds_mps
        return left_m + speeds[0] * time_s, right_m + speeds[1] * time_s


# A name has the side that is ahead or, side by side, slower (L or R; N: neither), the projected
# headway in m and the relative velocity in 0.1 m/s: in ``L_4_-8`` the left vehicle would be 4 m
# ahead at the merge point and is 0.8 m/s slower.
_NAMES = "R_-4_-8 R_-4_0 R_-4_8 R_-2_8 R_0_8 N_0_0 L_0_-8 L_2_-8 L_4_-8 L_4_0 L_4_8"
HUMAN_CONDITIONS = {
    name: Condition(float(name.split("_")[1]), int(name.split("_")[2]) / 10)
    for name in _NAMES.split()
}
"""Conditions of the human experiment (Siebinga et al., 4TU 19550377) and of the paper."""

NUMBER = r"-?\d{1,4}(?:\.\d{1,4})?"
"""Pattern of a headway or a velocity in the name of a condition."""
_COMPUTED = re.compile(f"h({NUMBER})_dv({NUMBER})", re.ASCII)


def condition_name(headway_m: float, velocity_mps: float) -> str:
    """Return the name of a condition at the usual mean speed.

    A condition of the humans has their name. Any other has its numbers, ``h2_dv-1.2``, and needs no
    registration.
    """
    for name, human in HUMAN_CONDITIONS.items():
        if (human.projected_headway_m, human.relative_velocity_mps) == (headway_m, velocity_mps):
            return name
    return f"h{_plain(headway_m)}_dv{_plain(velocity_mps)}"


def _plain(number: float) -> str:
    return f"{Decimal(repr(number + 0.0)).normalize():f}"  # + 0.0: no negative zero


class _Conditions(Registry[Condition]):
    """Registry of conditions that also computes those named by ``condition_name``."""

    def __getitem__(self, name: str) -> Condition:
        known = self._all
        if name in known or not (match := _COMPUTED.fullmatch(name)):
            return known[name]
        headway_m, velocity_mps = map(float, match.groups())
        if condition_name(headway_m, velocity_mps) == name:  # a condition has one name
            with suppress(UsageError):
                return Condition(headway_m, velocity_mps)
        raise KeyError(name)


CONDITIONS = _Conditions("condition")
"""Conditions that a sweep can play; a stored trial has its own numbers (table ``trials``)."""
for _name, _condition in HUMAN_CONDITIONS.items():
    CONDITIONS.register(_name, _condition)
