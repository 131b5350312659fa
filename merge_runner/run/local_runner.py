"""Plays trials with the clients of their models, in this process, and stores them meanwhile."""

from __future__ import annotations

import asyncio
import math
import sys
import traceback
from collections import Counter
from collections.abc import (
    AsyncIterator,
    Awaitable,
    Callable,
    Collection,
    Mapping,
    Sequence,
)
from contextlib import asynccontextmanager
from dataclasses import dataclass, field
from functools import partial
from itertools import accumulate, chain
from pathlib import Path

from merge_runner.drivers.base import MakeDriver
from merge_runner.drivers.language_model import LanguageModel
from merge_runner.errors import (
    NoValidDecision,
    ProviderDown,
    StoreError,
    StoreLocked,
    TrialSuspended,
)
from merge_runner.llm.batch.rounds import Rounds
from merge_runner.llm.cache import ResponseCache
from merge_runner.llm.call import Wait
from merge_runner.llm.client import LlmClient
from merge_runner.llm.http_outcome import REGISTRY
from merge_runner.llm.limiter import Limiter
from merge_runner.records import SIDES, ChatReply, Decision, Slot, TrialRecord, TrialSpec
from merge_runner.results.store import Store
from merge_runner.run.plan import Plan
from merge_runner.text_safety import one_line
from merge_runner.trial import play_trial

# Called with each trial that ends, or is suspended for lack of money.
Ended = Callable[[TrialSpec, TrialRecord | TrialSuspended], None]
# Awaited before a trial begins: returns once there is memory to hold the trial until it is stored.
Room = Callable[[], Awaitable[None]]
# More than bad luck explains, since nothing is answered between them; few enough to stop early.
FAILURES_IN_A_ROW = 10
# Calls that begin in one round of the event loop, so that each round stays short.
A_FEW = 16
# After so many without a valid one a live run stops, before much is paid for what is no result.
MOST_INVALID = 20
SHOWN = 300
ADVICE = (
    "look at what the prompt asks for, and in which output format; some servers hold a small "
    "model to it by a grammar. Where replies are cut off or empty, set a higher "
    f"`max_output_tokens` in {REGISTRY}"
)
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


class FirstDecisions:
    """The decisions of each model until one is valid, of which so many may be invalid.

    They are ``one_by_one`` where trials can wait for each other.
    """

    def __init__(self, most_invalid: float = math.inf, *, one_by_one: bool = False) -> None:
        self._most_invalid = most_invalid
        self._one_by_one = one_by_one
        self._valid: set[str] = set()
        self._invalid: Counter[str] = Counter()
        self._described: dict[str, str] = {}
        self._asked: set[str] = set()  # models that a trial asks alone
        self._changed = asyncio.Event()

    @asynccontextmanager
    async def turn(self, models: Collection[str]) -> AsyncIterator[None]:
        """Play a trial when its models have decided validly, or no other trial asks them."""
        self._check()
        alone = {*models} if self._one_by_one else set()
        while alone & self._asked - self._valid:
            self._changed.clear()
            await self._changed.wait()
        alone -= self._valid
        self._asked |= alone
        try:
            yield
        finally:
            self._asked -= alone
            self._changed.set()

    def count(self, model: str, decision: Decision) -> None:
        """Count a decision; raises NoValidDecision where too many are invalid."""
        if model not in self._valid:
            text = decision.reply.text if decision.reply else ""
            self.add(model, decision.valid, not decision.valid, decision.failure, text)
            self._check()

    def add(
        self, model: str, valid: int, invalid: int, failure: str | None, text: str | None
    ) -> None:
        """Count so many decisions; ``failure`` and ``text`` are of an invalid one."""
        if valid:
            self._valid.add(model)
            self._changed.set()
        if invalid:
            self._invalid[model] += invalid
            shown = one_line(" ".join((text or "").split()))[:SHOWN]
            reply = f'"{shown}" ({(failure or "").replace("_", " ")})'
            self._described.setdefault(model, f"The first reply is {reply}. To mend that {ADVICE}")

    def without_a_valid_one(self, least: float = 1) -> list[str]:
        """A line for each model with at least so many decisions none of which is valid."""
        return [
            f"none of the first {number} decisions of {model} is valid. {self._described[model]}"
            for model, number in sorted(self._invalid.items())
            if model not in self._valid and number >= least
        ]

    def _check(self) -> None:
        for line in self.without_a_valid_one(self._most_invalid):
            raise NoValidDecision(
                f"{line}. What was answered is kept; --keep-going goes on with such a model"
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
        self._arms = self.plan.by_label()
        models = {
            name: LanguageModel(
                partial(self._ask, name),
                self.plan.parts.prompts,
                partial(self.first.count, name),
                client.has_asked,
            )
            for name, client in self.clients.items()
        }
        self._drivers: dict[str, MakeDriver] = {**self.plan.parts.programs, **models}

    @classmethod
    def sealed(cls, plan: Plan, cache: ResponseCache, in_flight: int = 1) -> LocalRunner:
        """Return one that plays from recorded replies alone: no key, no connection.

        They come at once: more trials in flight would only wait for each other.
        """
        clients = {
            name: LlmClient(name, entry, plan.endpoints[name], cache, None, Limiter())
            for name, entry in plan.entries.items()
        }
        return cls(plan, clients, in_flight)

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
        arm = self._arms[spec.arm]
        asked = {*arm.asked.values()}
        async with self.first.turn(self.clients.keys() & asked):
            drivers = {
                side: self._drivers[arm.asked[side]].make(arm.scenario, spec, side)
                for side in SIDES
            }
            self.running += 1
            try:
                recorded = asked <= {name for name, c in self.clients.items() if c.sealed}
                if recorded:
                    await asyncio.sleep(0)  # nothing in such a trial lets anything else go on
                return await play_trial(spec, arm.scenario, drivers, in_turn=recorded)
            finally:
                self.running -= 1
                self._asking.pop(spec.order, None)
                for client in self.clients.values():
                    client.money.leave(spec.order)

    async def drain(self) -> None:
        """Let calls in flight end and be saved, and drop those that still wait for a turn."""
        await asyncio.gather(*(client.drain() for client in self.clients.values()))

    def _watch_for_outage(self, record: TrialRecord) -> None:
        """Stop when trials keep failing for one model that answers no call in between."""
        asked = self._arms[record.spec.arm].asked
        for name in {asked[failed.side] for failed in record.failed_calls}:
            if self.clients[name].sealed:
                continue
            since = name, self.clients[name].meter.calls_live
            self._failures_in_a_row[since] += 1
            failed = self._failures_in_a_row[since]
            if failed >= FAILURES_IN_A_ROW:
                raise ProviderDown(
                    f"the last {failed} trials with {name} failed and no call was answered "
                    f"in between ({record.error}): the rest is not tried. When the service answers "
                    "again, run the same command to go on"
                )

    async def _ask(self, model: str, prompt: str, slot: Slot, spec: TrialSpec) -> ChatReply:
        self._asking[spec.order] += 1
        try:
            client = self.clients[model]
            if not client.sealed:  # thousands of recorded replies would all be ready at once
                async with self._gate:
                    await asyncio.sleep(0)
            return await client.ask(prompt, slot, order=spec.order)
        finally:
            self._asking[spec.order] -= 1


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
        attempts = chain.from_iterable(call.attempts for call in record.calls)
        bytes_of_replies = sum(sys.getsizeof(attempt.reply) for attempt in attempts)
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
