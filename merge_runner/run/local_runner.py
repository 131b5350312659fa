"""Plays trials with the clients of their models, in this process."""

from __future__ import annotations

import asyncio
from collections import Counter
from collections.abc import Awaitable, Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property, partial

from merge_runner.drivers.base import MakeDriver
from merge_runner.drivers.language_model import LanguageModel
from merge_runner.drivers.registry import PROGRAMS
from merge_runner.errors import ProviderDown, TrialSuspended
from merge_runner.llm.client import LlmClient, Meter, Wait
from merge_runner.records import SIDES, ChatReply, Slot, TrialRecord, TrialSpec
from merge_runner.run.first_decisions import FirstDecisions
from merge_runner.run.plan import Plan
from merge_runner.run.scheduler import run_bounded
from merge_runner.study.crossing import Arm
from merge_runner.trial import play_trial

# Called with each trial that ends, or is suspended for lack of money.
Ended = Callable[[TrialSpec, TrialRecord | TrialSuspended], None]
# Awaited before a trial begins: returns once there is memory to hold the trial until it is stored.
Room = Callable[[], Awaitable[None]]


async def no_wait() -> None:
    """A Room without limits."""


# More than bad luck explains, since nothing is answered between them; few enough to stop early.
FAILURES_IN_A_ROW = 10
# Calls that begin in one round of the event loop, so that each round stays short.
A_FEW = 16


@dataclass
class LocalRunner:
    """Plays at most ``in_flight`` trials at once, of which so many are ``running``.

    ``asking`` counts the open questions of each trial.
    """

    plan: Plan
    clients: Mapping[str, LlmClient]
    in_flight: int
    first: FirstDecisions = field(default_factory=FirstDecisions)
    gate: asyncio.Semaphore = field(default_factory=partial(asyncio.Semaphore, A_FEW))
    running: int = 0
    asking: Counter[int] = field(default_factory=Counter)
    workers: None = None
    # Keyed by model and its number of answered calls, so that an answer starts a new count.
    _failures_in_a_row: Counter[tuple[str, int]] = field(default_factory=Counter)

    @cached_property
    def arms(self) -> Mapping[str, Arm]:
        """The arms of the study by their labels."""
        return self.plan.by_label()

    @cached_property
    def drivers(self) -> Mapping[str, MakeDriver]:
        """Makers of drivers by name: of a program, or of a model that one of the clients asks."""
        models = {
            name: LanguageModel(partial(self._ask, name), partial(self.first.count, name))
            for name in self.clients
        }
        return {**PROGRAMS, **models}

    @cached_property
    def _sealed(self) -> frozenset[str]:
        """The models whose answers are there, or nowhere."""
        return frozenset(name for name, client in self.clients.items() if client.sealed)

    @property
    def meters(self) -> Mapping[str, Meter]:
        """The meters of the clients."""
        return {name: client.meter for name, client in self.clients.items()}

    @property
    def in_flight_calls(self) -> int:
        """How many calls are in flight or being saved."""
        return sum(client.in_flight_calls for client in self.clients.values())

    @property
    def waits(self) -> Sequence[Wait]:
        """What the other calls wait for."""
        return [wait for client in self.clients.values() for wait in client.waits]

    @property
    def is_idle(self) -> bool:
        """Whether no trial goes on by itself: all ask, and wait for the answers to others."""
        idle = sum(client.idle_askers for client in self.clients.values())
        return self.running == len(self.asking) and self.asking.total() == idle

    @property
    def unsaved(self) -> str:
        """What Ctrl-C waits for, in words."""
        return f"{self.in_flight_calls} calls in flight"

    async def play(self, specs: Iterable[TrialSpec], ended: Ended, room: Room = no_wait) -> None:
        """Play trials in order; an error raised by ``ended`` or outside a trial ends the run."""

        def done(spec: TrialSpec, record: TrialRecord | TrialSuspended) -> None:
            ended(spec, record)
            if isinstance(record, TrialRecord):
                self._watch_for_outage(record)

        await run_bounded(
            (partial(self._trial, spec, room) for spec in specs),
            in_flight=self.in_flight,
            on_done=lambda result: done(*result),
        )

    async def play_one(self, spec: TrialSpec) -> TrialRecord:
        """Play one trial from recorded replies alone."""
        _, record = await self._trial(spec, no_wait)
        assert isinstance(record, TrialRecord)  # what asks nobody needs no money
        return record

    def _watch_for_outage(self, record: TrialRecord) -> None:
        """Stop when trials keep failing for one model that answers no call in between."""
        asked = self.arms[record.spec.arm].asked
        for name in {asked[failed.side] for failed in record.failed_calls} - self._sealed:
            since = name, self.clients[name].meter.calls_live
            self._failures_in_a_row[since] += 1
            failed = self._failures_in_a_row[since]
            if failed >= FAILURES_IN_A_ROW:
                raise ProviderDown(
                    f"the last {failed} trials with {name} failed and no call was answered "
                    f"in between ({record.error}): the rest is not tried. When the service answers "
                    "again, run the same command to go on"
                )

    async def drain(self) -> None:
        """Let calls in flight end and be saved, and drop those that still wait for a turn."""
        await asyncio.gather(*(client.drain() for client in self.clients.values()))

    async def _trial(
        self, spec: TrialSpec, room: Room
    ) -> tuple[TrialSpec, TrialRecord | TrialSuspended]:
        await room()  # before any call: what is answered must also be stored
        arm = self.arms[spec.arm]
        async with self.first.turn(self.clients.keys() & arm.asked.values()):
            return await self._played(spec, arm)

    async def _played(
        self, spec: TrialSpec, arm: Arm
    ) -> tuple[TrialSpec, TrialRecord | TrialSuspended]:
        drivers = {
            side: self.drivers[arm.asked[side]].make(arm.scenario, spec, side) for side in SIDES
        }
        self.running += 1
        try:
            recorded = all(name in self._sealed for name in arm.asked.values())
            if recorded:
                await asyncio.sleep(0)  # nothing in such a trial lets anything else go on
            return spec, await play_trial(spec, arm.scenario, drivers, in_turn=recorded)
        except TrialSuspended as exc:
            return spec, exc
        finally:
            self.running -= 1
            for client in self.clients.values():
                client.leave(spec.order)

    async def _ask(self, model: str, prompt: str, slot: Slot, spec: TrialSpec) -> ChatReply:
        self.asking[spec.order] += 1
        try:
            client = self.clients[model]
            if not client.sealed:  # thousands of recorded replies would all be ready at once
                async with self.gate:
                    await asyncio.sleep(0)
            return await client.ask(prompt, slot, order=spec.order)
        finally:
            self.asking[spec.order] -= 1
            if not self.asking[spec.order]:
                del self.asking[spec.order]
