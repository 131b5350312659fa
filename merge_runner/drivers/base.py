"""The protocol of a driver, and the context that a driver gets for one side of one trial."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Protocol

from merge_runner.config import ScenarioConfig
from merge_runner.drivers.pace import Pace
from merge_runner.errors import UsageError
from merge_runner.records import Decision, Observation, Side, other_side
from merge_runner.scenarios.merge.vehicle import net_acceleration
from merge_runner.trial_records import TrialSpec

Parameter = float | str


@dataclass(frozen=True, slots=True)
class DriverContext:
    """Context of a driver for one side of one trial.

    ``seed`` is a whole number below 2**64: all random draws of the driver in this trial come from
    it. ``other_seed`` is the other side's, so that both sides can share a draw. ``condition`` and
    ``repetition`` (from 1) describe the trial. ``parameters`` belong to the program, with the
    values that a study sets; ``data`` are the human trials that it replays.
    """

    scenario: ScenarioConfig
    side: Side
    pace: Pace
    seed: int
    other_seed: int
    condition: str
    repetition: int
    parameters: Mapping[str, Parameter]
    data: Any = None

    @property
    def interval_s(self) -> float:
        """The time between two decisions."""
        return self.pace.interval_steps * self.scenario.step_s

    def number(self, name: str) -> float:
        """Return the value of a parameter that is a number."""
        value = self.parameters[name]
        assert not isinstance(value, str), f"{name} is a text"
        return value

    def held(self, action: float) -> Decision:
        """Return the decision to hold one normalised acceleration over the whole horizon."""
        if not -1 <= action <= 1:
            raise UsageError(f"the {self.side} driver decided {action}: -1 to 1 can be driven")
        pace = self.pace
        return Decision((action,) * pace.plan_actions, (action,) * pace.executed_actions)

    def accelerating(self, net_mps2: float, speed_mps: float) -> Decision:
        """Return the decision that gives this net acceleration at this speed, within the limits."""
        resisted = net_acceleration(0.0, speed_mps, self.scenario.resistance)
        action = (net_mps2 - resisted) / self.scenario.max_acceleration_mps2
        return self.held(min(1.0, max(-1.0, action)))


class Driver(Protocol):
    """Driver of one vehicle in one trial."""

    @property
    def context(self) -> DriverContext:
        """The context that it was made with."""
        ...

    async def decide(self, observation: Observation, number: int) -> Decision:
        """Return the decision at a decision step, without awaiting anything.

        ``number`` is the decision step, from 0 at the start of control. With the control start
        ``own_exit`` that is the earlier exit, and the driver that exits later begins above 0. The
        runner steps the coroutine once; an audit does so without an event loop.
        """
        ...


class MakeDriver(Protocol):
    """Factory of the drivers of a side."""

    def make(self, scenario: ScenarioConfig, spec: TrialSpec, side: Side) -> Driver:
        """Return a new driver for one side of a trial."""
        ...


def make_context(
    scenario: ScenarioConfig,
    spec: TrialSpec,
    side: Side,
    pace: Pace,
    parameters: Mapping[str, Parameter] | None = None,
    data: Any = None,  # noqa: ANN401 # as of Program
) -> DriverContext:
    """Return the context of the driver of one side of a trial."""
    return DriverContext(
        scenario,
        side,
        pace,
        seed=_seed(spec, side),
        other_seed=_seed(spec, other_side(side)),
        condition=spec.condition,
        repetition=spec.repetition,
        parameters=parameters or {},
        data=data,
    )


def _seed(spec: TrialSpec, side: Side) -> int:
    """Return the first eight bytes of the SHA-256 of condition, repetition, side and sample set.

    It is the same on every machine, whoever drives.
    """
    slot = f"{spec.condition}/{spec.repetition}/{side}/{spec.sample_set}"
    return int.from_bytes(hashlib.sha256(slot.encode()).digest()[:8])
