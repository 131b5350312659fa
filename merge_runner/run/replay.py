"""Plays trials by recorded replies alone."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

from merge_runner.llm.call import Wait
from merge_runner.llm.recorded import RecordedCalls, RecordedReplies
from merge_runner.run.guard import FirstDecisions
from merge_runner.run.plan import Plan
from merge_runner.run.trials import Capacity, TrialMaker
from merge_runner.trial import play_trial
from merge_runner.trial_records import TrialRecord, TrialSpec


@dataclass
class Replay:
    """Player by recorded ``calls`` alone: no key, no connection, and nothing to wait for."""

    plan: Plan
    calls: RecordedCalls
    running_trials: int = 0
    waiting_for_money: int = 0
    waits: Sequence[Wait] = ()
    place: str = ""
    unsaved: str = "0 calls in flight"
    first: FirstDecisions = field(default_factory=FirstDecisions)
    _ahead: dict[int, TrialRecord] = field(default_factory=dict)  # by order, until it is their turn

    def __post_init__(self) -> None:
        plan, formats = self.plan, self.plan.parts.formats
        self._trials = TrialMaker(plan)
        self._models = {
            name: RecordedReplies(
                name, entry, plan.endpoints[name], formats[entry.format], self.calls
            )
            for name, entry in plan.entries.items()
        }
        self.meters = {name: model.meter for name, model in self._models.items()}

    def play_one(self, spec: TrialSpec) -> TrialRecord:
        """Play a trial."""
        played = self._ahead.pop(spec.order, None)
        return played or play_trial(
            self._trials.make(spec),
            lambda question: self._models[question.model].answer(question),
        )

    async def look_ahead(self, specs: Sequence[TrialSpec]) -> list[TrialRecord]:
        """Play trials until one has a recorded reply. Return the trials if none has, else none.

        ``play`` does not repeat them. Without a language model no trial is played.
        """
        for spec in specs if self._models else ():
            await asyncio.sleep(0)
            self._ahead[spec.order] = self.play_one(spec)
            if any(meter.calls_cached for meter in self.meters.values()):
                return []
        return [*self._ahead.values()]

    async def play(
        self,
        specs: Sequence[TrialSpec],
        ended: Callable[[TrialSpec, TrialRecord], None],
        capacity: Capacity | None = None,
    ) -> None:
        """Play trials in order; storing and the display go on between two of them."""
        for spec in specs:
            if capacity is not None:
                await capacity()
            await asyncio.sleep(0)
            ended(spec, self.play_one(spec))

    async def drain(self) -> None:
        """Do nothing: no call is in flight."""
