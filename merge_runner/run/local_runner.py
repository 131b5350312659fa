"""Plays trials with the clients of their models, in this process, and stores them meanwhile."""

from __future__ import annotations

import asyncio
import sys
import traceback
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from itertools import accumulate
from pathlib import Path

from merge_runner.drivers.language_model import Question
from merge_runner.errors import ProviderDown, StoreError, StoreLocked, TrialSuspended
from merge_runner.llm.batch.rounds import Rounds
from merge_runner.llm.call import Wait
from merge_runner.llm.client import LlmClient
from merge_runner.records import CallFailed, Decision, Side, TrialRecord, TrialSpec
from merge_runner.results.store import Store
from merge_runner.run.guard import FirstDecisions
from merge_runner.run.plan import Plan
from merge_runner.run.trials import Ended, Room, TrialMaker
from merge_runner.text_safety import one_line
from merge_runner.trial import Trial

# More than bad luck explains, since nothing is answered between them; few enough to stop early.
FAILURES_IN_A_ROW = 10
# Calls that begin in one round of the event loop, so that each round stays short.
A_FEW = 16
EVERY_S, POLL_S = 1.0, 0.05
# Trials in one transaction, which costs as much as storing dozens of them; and in memory while
# storing fails, as when another program holds the file.
BATCH = 256
MOST_PENDING = 2 * BATCH
BATCH_BYTES, MOST_PENDING_BYTES = 2**24, 2**25
DECISION_BYTES = 2_000  # with its share of the states
LOCK_PATIENCE_S = 2.0
AGAIN = (
    "When that is fixed, run the same command again: it writes them from the recorded replies "
    "without a call."
)


@dataclass
class LocalRunner:
    """Plays at most ``in_flight`` trials at once, of which so many are ``running``.

    What they ask in ``rounds`` is submitted when none of them can go on.
    """

    plan: Plan
    clients: Mapping[str, LlmClient]
    in_flight: int
    first: FirstDecisions = field(default_factory=FirstDecisions)
    rounds: Rounds | None = None
    running: int = 0
    workers: None = None
    # The open questions of each trial that is running and has asked.
    _asking: Counter[int] = field(default_factory=Counter)
    _gate: asyncio.Semaphore = field(default_factory=partial(asyncio.Semaphore, A_FEW))
    # Keyed by model and its number of answered calls, so that an answer starts a new count.
    _failures_in_a_row: Counter[tuple[str, int]] = field(default_factory=Counter)

    def __post_init__(self) -> None:
        self.meters = {name: client.meter for name, client in self.clients.items()}
        self._trials = TrialMaker(self.plan)

    @property
    def waits(self) -> Sequence[Wait]:
        """What the calls wait for that are not in flight."""
        return [wait for client in self.clients.values() for wait in client.waits]

    def _is_idle(self) -> bool:
        """Whether no trial goes on by itself: all ask, and wait for the answers to others."""
        idle = sum(client.idle_askers for client in self.clients.values())
        asking = +self._asking  # without the trials that ask nothing now
        return self.running == len(asking) and asking.total() == idle

    @property
    def unsaved(self) -> str:
        """What Ctrl-C waits for, in words."""
        calls = sum(client.in_flight_calls for client in self.clients.values())
        return f"{calls} calls in flight"

    async def play(
        self, specs: Sequence[TrialSpec], ended: Ended, room: Room | None = None
    ) -> None:
        """Play trials in order; an error raised by ``ended`` or outside a trial ends the run."""
        waiting = iter(specs)

        async def work() -> None:
            for spec in waiting:
                if room is not None:  # before any call: what is answered must also be stored
                    await room()
                try:
                    record = await self.play_one(spec)
                except TrialSuspended as exc:
                    ended(spec, exc)
                else:
                    ended(spec, record)
                    self._watch_for_outage(record)

        try:
            async with asyncio.TaskGroup() as group:
                playing = [group.create_task(work()) for _ in specs[: self.in_flight]]
                if self.rounds is not None:
                    watching = group.create_task(self.rounds.watch(self._is_idle))
                    await asyncio.gather(*playing)
                    watching.cancel()
        except BaseExceptionGroup as errors:  # the first one has cancelled the others
            raise errors.exceptions[0] from None

    async def play_one(self, spec: TrialSpec) -> TrialRecord:
        """Play a trial; raises TrialSuspended where there is no money for it."""
        asked = {*self._trials.arms[spec.arm].asked.values()}
        async with self.first.turn(self.clients.keys() & asked):
            self.running += 1
            try:
                return await self._play(self._trials.make(spec), spec.order)
            finally:
                self.running -= 1
                self._asking.pop(spec.order, None)
                for client in self.clients.values():
                    client.money.leave(spec.order)

    async def _play(self, trial: Trial, order: int) -> TrialRecord:
        """Ask all that is pending side by side; where a driver raises, no other one goes on."""
        while questions := trial.pending():
            try:
                async with asyncio.TaskGroup() as group:
                    asking = [
                        group.create_task(self._ask(question, order, trial))
                        for question in questions
                    ]
            except BaseExceptionGroup as errors:
                raise errors.exceptions[0] from None
            trial.answer(dict(filter(None, (task.result() for task in asking))))
        return trial.record()

    async def drain(self) -> None:
        """Let calls in flight end and be saved, and drop those that still wait for a turn."""
        await asyncio.gather(*(client.drain() for client in self.clients.values()))

    def _watch_for_outage(self, record: TrialRecord) -> None:
        """Stop when trials keep failing for one model that answers no call in between."""
        asked = self._trials.arms[record.spec.arm].asked
        for name in {asked[failed.side] for failed in record.failed_calls}:
            since = name, self.clients[name].meter.calls_live
            self._failures_in_a_row[since] += 1
            failed = self._failures_in_a_row[since]
            if failed >= FAILURES_IN_A_ROW:
                raise ProviderDown(
                    f"the last {failed} trials with {name} failed and no call was answered "
                    f"in between ({record.error}): the rest is not tried. When the service answers "
                    "again, run the same command to go on"
                )

    async def _ask(
        self, question: Question, order: int, trial: Trial
    ) -> tuple[Side, Decision] | None:
        """Return a decision; None where its call failed, which ends the trial."""
        client, side = self.clients[question.model], question.slot.side
        self._asking[order] += 1
        try:
            async with self._gate:  # thousands of recorded replies would all be ready at once
                await asyncio.sleep(0)
            prompt = client.recorded.prompt(question)
            reply = await client.ask(prompt, question.slot, order=order)
        except CallFailed as failure:
            trial.fail(side, failure)
            return None
        finally:
            self._asking[order] -= 1
        decision = question.decide(prompt, reply)
        if question.model not in self.first.valid:
            self.first.count(question.model, decision)
        return side, decision


class Flusher:
    """Collects ended trials and stores them about once a second.

    While storing fails, trials beyond a batch are dropped and others are played; where storing is
    merely slow, new trials wait for it. ``dropped`` trials can be played again from the recorded
    replies; failed ones cannot, and stay in memory. ``differing`` maps trials that were already
    stored with other values to the columns that differ. After an error that is no StoreError it is
    ``broken``: it writes nothing more, and calls ``on_break`` once.
    """

    def __init__(self, store: Store, sweep_id: str, say: Callable[[str], None]) -> None:
        self.differing: dict[str, list[str]] = {}
        self.dropped: list[TrialSpec] = []
        self.broken = False
        self.on_break: Callable[[], object] = lambda: None
        self._store = store
        self._sweep_id = sweep_id
        self._say = say
        self._pending: list[tuple[TrialRecord, int]] = []  # with their bytes
        self._problem: StoreError | None = None
        self._closing = False
        self._task = asyncio.create_task(self._run())

    def add(self, record: TrialRecord) -> None:
        """Store this trial with the next batch, or drop it while storing fails."""
        attempts = [attempt for call in record.calls for attempt in call.attempts]
        bytes_of_replies = sum([sys.getsizeof(attempt.reply) for attempt in attempts])
        size = bytes_of_replies + DECISION_BYTES * len(record.decisions)
        self._pending.append((record, size))
        if self._problem is not None:
            self._drop_excess()

    async def room(self) -> None:
        """Wait while too much is still to be stored, unless storing fails or has ended."""
        while self._problem is None and not self._task.done():
            if len(self._pending) <= MOST_PENDING and self._bytes <= MOST_PENDING_BYTES:
                return
            await asyncio.sleep(POLL_S)

    @property
    def left(self) -> int:
        """How many trials are not stored yet."""
        return len(self._pending) + len(self.dropped)

    @property
    def problem(self) -> str:
        """Why trials are not stored, as a line of text; empty where nothing is wrong."""
        if self._problem is None:
            return ""
        what = f"{self.left} trials wait" if self.left else "how the sweep ended waits"
        return f"{what} to be stored: {self._problem}"

    async def close(self) -> None:
        """Store the trials in memory, and leave the database reachable.

        Waits for a program that holds it as long as that does; raises StoreError for anything else.
        More trials may be added later, and stored by the next call.
        """
        self._closing = True
        await self._task
        said = False
        while not await self._flush() or self._pending:
            if isinstance(self._problem, StoreLocked):
                if not said:
                    self._say(
                        f"the playing has ended; {self.problem}. Ctrl-C ends the waiting: all "
                        "replies are in the cache"
                    )
                said = True
                await asyncio.sleep(EVERY_S)
            elif self._problem and self.left:
                raise StoreError(f"{self.left} trials are not stored: {self._problem}. {AGAIN}")
            elif self._problem:
                return  # whoever opens the database next will say what is wrong with it

    @property
    def _bytes(self) -> int:
        return sum(size for _, size in self._pending)

    async def _run(self) -> None:
        clock_s = asyncio.get_running_loop().time
        flushed_s = clock_s()
        while not self._closing:
            await asyncio.sleep(POLL_S)
            is_much = len(self._pending) >= BATCH or self._bytes >= BATCH_BYTES
            if self._pending and (is_much or clock_s() - flushed_s >= EVERY_S):
                flushed_s = clock_s()
                await self._flush()

    async def _flush(self) -> bool:
        """Write one batch, which may be empty; False if that did not work."""
        if self.broken:
            return False
        sizes = accumulate(size for _, size in self._pending[:BATCH])
        # At least one: a single trial may be larger than a batch should be.
        number = max(1, sum(size <= BATCH_BYTES for size in sizes))
        # It stays in front until it is stored: others are added behind it meanwhile.
        batch = [record for record, _ in self._pending[:number]]
        # In a thread, since DuckDB waits for the file's lock and for the disk.
        write = partial(self._store.write, self._sweep_id, batch, patience_s=LOCK_PATIENCE_S)
        writing = asyncio.create_task(asyncio.to_thread(write))
        await asyncio.wait([writing])
        if (error := writing.exception()) is not None:
            self._fail(error)
            return False
        self.differing |= writing.result()
        self._problem = None
        del self._pending[: len(batch)]
        return True

    def _fail(self, error: BaseException) -> None:
        """Note why a batch is not written."""
        if isinstance(error, StoreError):
            self._problem = error
        else:
            place = traceback.extract_tb(error.__traceback__)[-1]
            self._problem = StoreError(
                f"the writer of results has failed ({one_line(repr(error))} in "
                f"{Path(place.filename).name}, line {place.lineno})"
            )
            self.broken = True
            self.on_break()
        self._drop_excess()

    def _drop_excess(self) -> None:
        """Drop the newest trials beyond what may wait, which are in no batch under way."""
        pending, self._pending = self._pending, []
        held_bytes = 0
        for record, size in pending:
            is_much = len(self._pending) >= BATCH or held_bytes + size > MOST_PENDING_BYTES
            if is_much and self._pending and record.status != "failed":
                self.dropped.append(record.spec)
            else:
                self._pending.append((record, size))
                held_bytes += size
