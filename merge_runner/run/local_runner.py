"""Plays trials with the clients of their models, in this process."""

from __future__ import annotations

import asyncio
from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial

from merge_runner.drivers.language_model import Question
from merge_runner.errors import ProviderDown, TrialSuspended
from merge_runner.llm.batch.rounds import Rounds
from merge_runner.llm.call import Calls, Wait
from merge_runner.llm.client import LlmClient
from merge_runner.records import CallFailed, Decision, Side
from merge_runner.run.guard import FirstDecisions
from merge_runner.run.plan import Plan
from merge_runner.run.trials import Capacity, Ended, TrialMaker
from merge_runner.trial import Trial
from merge_runner.trial_records import TrialRecord, TrialSpec

# Without an answer in between, so many failures are hardly chance.
FAILURES_IN_A_ROW = 10
# Trials that begin or go on in one round of the event loop, so that each round stays short.
A_FEW = 16


@dataclass
class LocalRunner:
    """Player of at most ``in_flight`` trials at once in this process.

    With ``rounds`` their calls are submitted in batches when no trial can go on.
    """

    plan: Plan
    clients: Mapping[str, LlmClient]
    in_flight: int
    first: FirstDecisions = field(default_factory=FirstDecisions)
    rounds: Rounds | None = None
    calls: Calls = field(default_factory=Calls)
    running_trials: int = 0
    place: str = ""
    # Numbers of open questions, by trial.
    _open_questions: Counter[int] = field(default_factory=Counter)
    _gate: asyncio.Semaphore = field(default_factory=partial(asyncio.Semaphore, A_FEW))
    # Keys of calls that failed since a model's last answer, by model and number of its answers.
    _failed: dict[tuple[str, int], set[str]] = field(default_factory=partial(defaultdict, set))

    def __post_init__(self) -> None:
        self.meters = {name: client.meter for name, client in self.clients.items()}
        self._trials = TrialMaker(self.plan)

    @property
    def waits(self) -> Sequence[Wait]:
        """The waits of calls that are not in flight."""
        return self.calls.waits

    @property
    def waiting_for_money(self) -> int:
        """The number of running trials that wait for money."""
        return len(set().union(*(client.budget.queue.trials for client in self.clients.values())))

    def _is_idle(self) -> bool:
        """Return whether all open questions wait for blocked calls, so that no trial can go on."""
        asking = +self._open_questions  # without trials that have no open question
        return self.running_trials == len(asking) and asking.total() == self.calls.blocked_askers

    @property
    def unsaved(self) -> str:
        """Text of what an interrupted run saves before it ends."""
        return f"{self.calls.calls_in_flight} calls in flight"

    async def play(
        self, specs: Sequence[TrialSpec], ended: Ended, capacity: Capacity | None = None
    ) -> None:
        """Play trials in order; pass each record, or TrialSuspended, to ``ended``.

        Any other error, also one that ``ended`` raises, ends the run.
        """
        waiting = iter(specs)

        async def work() -> None:
            for spec in waiting:
                if capacity is not None:  # before any call: what is answered must also be stored
                    await capacity()
                try:
                    record = await self.play_one(spec)
                except TrialSuspended as exc:
                    ended(spec, exc)
                else:
                    ended(spec, record)
                    self._watch_for_outage(record)

        try:
            async with asyncio.TaskGroup() as group:
                playing = []
                for _ in specs[: self.in_flight]:
                    playing.append(group.create_task(work()))
                    if len(playing) % A_FEW == 0:
                        await asyncio.sleep(0)
                if self.rounds is not None:
                    watching = group.create_task(self.rounds.watch(self._is_idle))
                    await asyncio.gather(*playing)
                    watching.cancel()
        except BaseExceptionGroup as errors:  # the first one has cancelled the others
            raise errors.exceptions[0] from None

    async def play_one(self, spec: TrialSpec) -> TrialRecord:
        """Play a trial; raises TrialSuspended where there is no money for it."""
        models = {*self._trials.arms[spec.arm].full_names.values()}
        async with self.first.turn(self.clients.keys() & models):
            self.running_trials += 1
            try:
                return await self._ask_and_advance(spec)
            finally:
                self.running_trials -= 1
                self._open_questions.pop(spec.order, None)
                for client in self.clients.values():
                    client.budget.leave(spec.order)

    async def _ask_and_advance(self, spec: TrialSpec) -> TrialRecord:
        """Ask all pending questions at once; an error of one driver cancels the others."""
        await self._next_round()
        trial = self._trials.make(spec)
        while questions := trial.pending():
            try:
                async with asyncio.TaskGroup() as group:
                    asking = [
                        group.create_task(self._ask(question, spec.order, trial))
                        for question in questions
                    ]
            except BaseExceptionGroup as errors:
                raise errors.exceptions[0] from None
            trial.answer(dict(filter(None, (task.result() for task in asking))))
            await self._next_round()
        return trial.record()

    async def _next_round(self) -> None:
        """Wait for a round of the event loop with room for a trial.

        Without the gate, all trials whose replies are stored would go on in one round.
        """
        async with self._gate:
            await asyncio.sleep(0)

    async def drain(self) -> None:
        """Let calls in flight end and be saved, and drop those that still wait for a turn."""
        await self.calls.drain()

    def _watch_for_outage(self, record: TrialRecord) -> None:
        """Stop when trials keep failing for one model that answers no call in between."""
        names = self._trials.arms[record.spec.arm].full_names
        for call in record.failed_calls:
            name = names[call.side]
            failed = self._failed[name, self.clients[name].meter.calls_live]
            failed.add(call.request.key)  # trials may share a failed call: it counts once
            if len(failed) >= FAILURES_IN_A_ROW:
                raise ProviderDown(
                    f"{len(failed)} different calls to {name} failed and none was answered in "
                    f"between ({record.error}): the rest is not tried. When the service answers "
                    "again, run the same command to go on"
                )

    async def _ask(
        self, question: Question, order: int, trial: Trial
    ) -> tuple[Side, Decision] | None:
        """Return a decision; None where its call failed, which ends the trial."""
        client, side = self.clients[question.model], question.slot.side
        self._open_questions[order] += 1
        try:
            decision = await client.answer(question, order=order)
        except CallFailed as failure:
            trial.fail(side, failure)
            return None
        finally:
            self._open_questions[order] -= 1
        if question.model not in self.first.valid:
            self.first.count_decision(question.model, decision)
        return side, decision
