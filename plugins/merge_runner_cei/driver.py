"""One driver of the model at the wheel of a trial."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, fields
from typing import TYPE_CHECKING

from merge_runner.config import Resistance, whole_steps
from merge_runner.drivers.program_seat import Parameter, ProgramSeat
from merge_runner.drivers.registry import PROGRAMS, SET, Program
from merge_runner.errors import UsageError
from merge_runner.records import Decision, Observation
from merge_runner_cei.parameters import OFFSETS, RISKS, SETS, TICK_S, ThresholdSet

if TYPE_CHECKING:
    from merge_runner_cei.seated import Seated

BY_RESISTANCE = "by-resistance"
USUAL_SETS: dict[Resistance, str] = {"human": "K0", "none": "drag-free"}
PAIR = "pair"


class CeiDriver:
    """See Driver; it loads numpy and scipy with its first decision."""

    def __init__(self, seat: ProgramSeat) -> None:
        self.seat = seat
        self.ticks = round(seat.interval_s / TICK_S)
        self._seated: Seated | None = None

    async def decide(self, observation: Observation, number: int) -> Decision:
        """Hold the input of the present plan, which stays until there is a reason for another."""
        from merge_runner_cei.seated import Seated

        if self._seated is None:
            self._seated = Seated(self.seat, thresholds_of(self.seat), observation)
            return self.seat.held(self._seated.decide(observation, 1))
        return self.seat.held(self._seated.decide(observation, self.ticks))


def thresholds_of(seat: ProgramSeat) -> ThresholdSet:
    """Those that a study gives, or those that suit its resistance."""
    if seat.parameters[SET] == BY_RESISTANCE:
        return SETS[USUAL_SETS[seat.scenario.resistance]]
    return ThresholdSet(**{each.name: seat.number(each.name) for each in fields(ThresholdSet)})


def check(parameters: Mapping[str, Parameter]) -> None:
    """Raises UsageError for a pair that there is not, and for thresholds that are no risks."""
    if parameters[PAIR] not in range(len(OFFSETS) + 1):
        raise UsageError(
            f"the driver cei has no pair {parameters[PAIR]}: 1 to {len(OFFSETS)} can be chosen, "
            "and 0 takes turns by the repetition"
        )
    for name in sorted(parameters.keys() & RISKS):
        if not 0 <= float(parameters[name]) <= 1:
            raise UsageError(f"{name} of cei is a risk: from 0 to 1, not {parameters[name]}")


def check_clock(_: Mapping[str, Parameter], clock_s: float) -> None:
    """Raises UsageError for a clock that is no whole number of ticks."""
    try:
        whole_steps("clock", clock_s, TICK_S)
    except ValueError as exc:
        raise UsageError(f"the driver cei perceives every {TICK_S} s: {exc}") from exc


PROGRAMS.register(
    "cei",
    Program(
        CeiDriver,
        "a model of human merging (Siebinga et al. 2024), re-implemented with thresholds of ours",
        {SET: BY_RESISTANCE, PAIR: 0},
        1 / TICK_S,
        settable=True,
        sets={BY_RESISTANCE: {}, **{name: asdict(one) for name, one in SETS.items()}},
        check=check,
        check_clock=check_clock,
        chance=True,
    ),
)
