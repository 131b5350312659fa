"""The program ``cei`` and its parameters."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

from merge_runner.config import Resistance, whole_steps
from merge_runner.drivers.base import DriverContext, Parameter
from merge_runner.drivers.cei.parameters import OFFSETS, RISKS, SETS, TICK_S, ThresholdSet
from merge_runner.drivers.registry import PROGRAMS, SET, Program
from merge_runner.errors import UsageError
from merge_runner.records import Decision, Observation

if TYPE_CHECKING:
    from merge_runner.drivers.cei.agent import Agent

BY_RESISTANCE = "by-resistance"
USUAL_SETS: dict[Resistance, str] = {"human": "K0", "none": "drag-free"}
PAIR = "pair"


class CeiDriver:
    """Driver by the model; numpy and scipy are imported at its first decision."""

    def __init__(self, context: DriverContext) -> None:
        self.context = context
        self.ticks = round(context.interval_s / TICK_S)
        self._agent: Agent | None = None

    async def decide(self, observation: Observation, number: int) -> Decision:
        """Hold the input of the current plan, which stays until there is a reason to replan."""
        from merge_runner.drivers.cei.agent import Agent

        if self._agent is None:
            self._agent = Agent(self.context, thresholds_of(self.context), observation)
            return self.context.held(self._agent.decide(observation, 1))
        return self.context.held(self._agent.decide(observation, self.ticks))


def thresholds_of(context: DriverContext) -> ThresholdSet:
    """Return the thresholds that a study sets, or those calibrated for its resistance."""
    if context.parameters[SET] == BY_RESISTANCE:
        return SETS[USUAL_SETS[context.scenario.resistance]]
    return ThresholdSet(*map(context.number, ThresholdSet._fields))


def check(parameters: Mapping[str, Parameter]) -> None:
    """Raise UsageError for an unknown pair, and for a threshold that is no risk."""
    if parameters[PAIR] not in range(len(OFFSETS) + 1):
        raise UsageError(
            f"the driver cei has no pair {parameters[PAIR]}: 1 to {len(OFFSETS)} can be chosen, "
            "and 0 takes turns by the repetition"
        )
    for name in sorted(parameters.keys() & RISKS):
        if not 0 <= float(parameters[name]) <= 1:
            raise UsageError(f"{name} of cei is a risk: from 0 to 1, not {parameters[name]}")


def check_clock(_: Mapping[str, Parameter], clock_s: float) -> None:
    """Raise UsageError for a clock that is no whole number of ticks."""
    try:
        whole_steps("clock", clock_s, TICK_S)
    except ValueError as exc:
        raise UsageError(f"the driver cei perceives every {TICK_S} s: {exc}") from exc


PROGRAMS.register(
    "cei",
    Program(
        CeiDriver,
        "predicts the other vehicle, and plans anew when the collision risk it perceives leaves "
        "two thresholds (model of Siebinga et al. 2024, thresholds of our own)",
        {SET: BY_RESISTANCE, PAIR: 0},
        1 / TICK_S,
        settable=True,
        sets={BY_RESISTANCE: {}, **{name: values._asdict() for name, values in SETS.items()}},
        check=check,
        check_clock=check_clock,
        chance=True,
    ),
)
