"""The program ``human-odds``, a descriptive null: order and gap by regressions of human data."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from math import exp
from random import Random

from merge_runner.drivers.base import DriverContext, Parameter
from merge_runner.drivers.registry import PROGRAMS, Program
from merge_runner.errors import UsageError
from merge_runner.records import Decision, Observation

# The human rows of arXiv 2604.09609, Tables III (odds that the left one goes first) and IV (gap
# in m). The spread of the gap about its mean is what the standard errors of Table IV imply.
PARAMETERS = {
    "odds_intercept": -0.30,
    "odds_headway": 1.11,
    "odds_velocity": -3.30,
    "gap_intercept_m": 3.54,
    "gap_abs_headway": 0.17,
    "gap_abs_velocity_s": -0.20,
    "gap_headway_x_velocity_s": 0.06,
    "gap_sd_m": 1.82,
}
SLOWEST_MPS = 0.1
CERTAIN = 700.0  # log odds beyond which exp has no number


@dataclass(slots=True)
class HumanOddsDriver:
    """Driver that draws the order and the gap when it sees the other, and does not look again.

    Before that it keeps its speed. The first vehicle keeps it. The second one holds one
    acceleration that opens the gap until the first is at the merge point, and then keeps its speed.
    Both sides draw from both seeds, and agree under perfect perception. Under imperfect perception
    their odds differ: both may go first, or neither.
    """

    context: DriverContext
    _acceleration_mps2: float = 0.0
    _until: float | None = None
    _random: Random = field(init=False)

    def __post_init__(self) -> None:
        self._random = Random(self.context.seed)

    async def decide(self, observation: Observation, number: int) -> Decision:
        """Hold the acceleration, or keep the speed."""
        if self._until is None and observation.other_seen:
            self._until = number + self._choose(observation) / self.context.interval_s
        holding = self._until is not None and number < self._until - 1e-9
        return self.context.accelerating(
            self._acceleration_mps2 if holding else 0.0, observation.own_speed_mps
        )

    def _choose(self, seen: Observation) -> float:
        """Set the acceleration, and return for how many seconds it is held."""
        distance = seen.distance_to_merge_m
        other_distance = None if distance is None else distance - seen.relative_distance_m
        if distance is None or other_distance is None or min(distance, other_distance) <= 0:
            return 0.0
        own_s = distance / max(seen.own_speed_mps, SLOWEST_MPS)
        other_s = other_distance / max(seen.other_speed_mps, SLOWEST_MPS)
        first_s = min(own_s, other_s)
        velocity = seen.own_speed_mps - seen.other_speed_mps
        headway = velocity * first_s - seen.relative_distance_m
        if self._goes_first(headway, velocity):
            return 0.0
        distance_m = self._gap_m(headway, velocity) + self.context.scenario.vehicle_length_m
        spare = distance - seen.own_speed_mps * other_s
        self._acceleration_mps2 = min(0.0, 2 * (spare - distance_m) / other_s**2)
        return other_s

    def _goes_first(self, headway_m: float, velocity_mps: float) -> bool:
        """Return True if this side wins a race of two exponential times: with the human odds."""
        number, sign = self.context.number, 1 if self.context.side == "left" else -1
        log_odds = number("odds_intercept") * sign
        log_odds += number("odds_headway") * headway_m + number("odds_velocity") * velocity_mps
        ego, other = self._random, Random(self.context.other_seed)
        return ego.expovariate(1.0) < exp(min(log_odds, CERTAIN)) * other.expovariate(1.0)

    def _gap_m(self, headway_m: float, velocity_mps: float) -> float:
        number = self.context.number
        mean_m = (
            number("gap_intercept_m")
            + number("gap_abs_headway") * abs(headway_m)
            + number("gap_abs_velocity_s") * abs(velocity_mps)
            + number("gap_headway_x_velocity_s") * headway_m * velocity_mps
        )
        return mean_m + number("gap_sd_m") * self._random.gauss()


def _check(parameters: Mapping[str, Parameter]) -> None:
    if float(parameters["gap_sd_m"]) < 0:
        raise UsageError("gap_sd_m of human-odds cannot be below 0")


PROGRAMS.register(
    "human-odds",
    Program(
        HumanOddsDriver,
        "draws who goes first and the gap from regressions of the human data, "
        "and then holds one acceleration",
        PARAMETERS,
        20.0,
        settable=True,
        check=_check,
        chance=True,
        from_humans=True,
    ),
)
