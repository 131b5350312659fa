"""The trials of a plan, and the interface of their players."""

from __future__ import annotations

from collections.abc import Awaitable, Callable, Sequence
from typing import Protocol

from merge_runner.drivers.base import MakeDriver
from merge_runner.drivers.language_model import LanguageModel
from merge_runner.errors import TrialSuspended
from merge_runner.llm.attempts import Meter
from merge_runner.llm.call import Wait
from merge_runner.records import SIDES
from merge_runner.run.guard import FirstDecisions
from merge_runner.run.plan import Plan
from merge_runner.trial import Trial
from merge_runner.trial_records import TrialRecord, TrialSpec

# Called with each trial that ends, or is suspended for lack of money.
Ended = Callable[[TrialSpec, TrialRecord | TrialSuspended], None]
# Awaited before a trial begins: returns once there is memory to hold the trial until it is stored.
Capacity = Callable[[], Awaitable[None]]


class Player(Protocol):
    """Player of trials: from recorded replies, in this process, or on a cluster.

    ``meters`` are by model.
    """

    meters: dict[str, Meter]

    @property
    def first(self) -> FirstDecisions:
        """The first decisions of each model."""

    @property
    def waits(self) -> Sequence[Wait]:
        """The reasons why calls wait that are not in flight."""

    @property
    def running_trials(self) -> int:
        """The number of trials under way."""

    @property
    def waiting_for_money(self) -> int:
        """The number of trials that wait for money, as far as this process knows."""

    @property
    def place(self) -> str:
        """Text of the workers that they are on; empty: they are in this process."""

    @property
    def unsaved(self) -> str:
        """Text of what an interrupted run saves before it ends."""

    async def play(self, specs: Sequence[TrialSpec], ended: Ended, capacity: Capacity) -> None:
        """Play trials in order; any error but TrialSuspended, also of ``ended``, ends the run."""

    async def drain(self) -> None:
        """Let calls in flight end and be saved."""


class TrialMaker:
    """Factory of the trials of a plan."""

    def __init__(self, plan: Plan) -> None:
        self.arms = plan.by_label()
        models = {name: LanguageModel(name, plan.parts.prompts) for name in plan.entries}
        self._drivers: dict[str, MakeDriver | LanguageModel] = {**plan.parts.programs, **models}

    def make(self, spec: TrialSpec) -> Trial:
        """Return a trial before its first decision."""
        arm = self.arms[spec.arm]
        drivers = {
            side: self._drivers[arm.full_names[side]].make(arm.scenario, spec, side)
            for side in SIDES
        }
        return Trial(spec, arm.scenario, drivers)
