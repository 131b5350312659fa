"""The 11 kinematic conditions of the human experiment (Siebinga et al., 4TU 19550377).

A name says who has the projected headway advantage (L, R or N), the projected headway in m and
the relative velocity in 0.1 m/s, both left minus right: in ``L_4_-8`` the left vehicle would be
4 m ahead at the merge point and is 0.8 m/s slower.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

from merge_runner.scenarios.merge.geometry import MERGE_POINT_M, TUNNEL_EXIT_M

MEAN_SPEED_MPS = 10.0


@dataclass(frozen=True)
class Condition:
    """One condition: projected headway and relative velocity, signed left minus right."""

    name: str
    projected_headway_m: float
    relative_velocity_mps: float

    @property
    def speeds_mps(self) -> tuple[float, float]:
        """Initial speeds (left, right)."""
        half = self.relative_velocity_mps / 2
        return MEAN_SPEED_MPS + half, MEAN_SPEED_MPS - half

    @cached_property
    def starts_m(self) -> tuple[float, float]:
        """Travelled distances (left, right) at the start of the run, inside the tunnels.

        The projected leader stands at the merge point, the other |h| behind; both run backwards
        at constant speed until one of them is at 0.
        """
        speed_left, speed_right = self.speeds_mps
        left = MERGE_POINT_M + min(self.projected_headway_m, 0.0)
        right = MERGE_POINT_M - max(self.projected_headway_m, 0.0)
        seconds = min(left / speed_left, right / speed_right)
        return left - speed_left * seconds, right - speed_right * seconds

    @property
    def exit_times_s(self) -> tuple[float, float]:
        """When (left, right) leave their tunnels at constant speed, from the start of the run."""
        (start_left, start_right), (speed_left, speed_right) = self.starts_m, self.speeds_mps
        return (TUNNEL_EXIT_M - start_left) / speed_left, (
            TUNNEL_EXIT_M - start_right
        ) / speed_right

    def positions_m(self, time_s: float) -> tuple[float, float]:
        """Travelled distances (left, right) at constant speed, ``time_s`` into the run."""
        (start_left, start_right), (speed_left, speed_right) = self.starts_m, self.speeds_mps
        return start_left + speed_left * time_s, start_right + speed_right * time_s


def _condition(name: str) -> Condition:
    _, headway, velocity = name.split("_")
    return Condition(name, float(headway), int(velocity) / 10)


CONDITIONS: dict[str, Condition] = {
    name: _condition(name)
    for name in (
        "R_-4_-8",
        "R_-4_0",
        "R_-4_8",
        "R_-2_8",
        "R_0_8",
        "N_0_0",
        "L_0_-8",
        "L_2_-8",
        "L_4_-8",
        "L_4_0",
        "L_4_8",
    )
}
