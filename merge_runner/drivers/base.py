"""What every driver is to a trial, and what it is given."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from typing import Protocol

from merge_runner.config import ScenarioConfig
from merge_runner.drivers.pace import Pace
from merge_runner.errors import UsageError
from merge_runner.records import Decision, Observation, Side, TrialSpec


@dataclass(frozen=True, slots=True)
class Seat:
    """What a driver is given for one side of one trial.

    ``seed`` is a whole number below 2**64 from which it draws whatever it leaves to chance.
    """

    scenario: ScenarioConfig
    side: Side
    pace: Pace
    seed: int

    def held(self, action: float) -> Decision:
        """The decision to hold one normalised acceleration over the whole horizon."""
        if not -1 <= action <= 1:
            raise UsageError(f"the {self.side} driver decided {action}: -1 to 1 can be driven")
        pace = self.pace
        return Decision((action,) * pace.plan_actions, (action,) * pace.executed_actions)


class Driver(Protocol):
    """One vehicle's driver for one trial."""

    @property
    def seat(self) -> Seat:
        """What it was given."""
        ...

    async def decide(self, observation: Observation, number: int) -> Decision:
        """Decide at the ``number``-th instant of its own pace; raises CallFailed.

        Instants count from 0, the start of control. With the control start ``own_exit`` that is
        the earlier exit, and the first number of the driver that exits later is above 0.
        """
        ...


class MakeDriver(Protocol):
    """Whatever makes the driver of a side of a trial: a program, or a language model."""

    def make(self, scenario: ScenarioConfig, spec: TrialSpec, side: Side) -> Driver:
        """A driver that has not decided yet."""
        ...


def take_seat(scenario: ScenarioConfig, spec: TrialSpec, side: Side, pace: Pace) -> Seat:
    """The seat of a side of a trial.

    Its seed is the first eight bytes of the SHA-256 of condition, repetition, side and sample set:
    the same on every machine, whoever drives.
    """
    slot = f"{spec.condition}/{spec.repetition}/{side}/{spec.sample_set}"
    seed = int.from_bytes(hashlib.sha256(slot.encode()).digest()[:8])
    return Seat(scenario, side, pace, seed)
