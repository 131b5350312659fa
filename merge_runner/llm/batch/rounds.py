"""Rounds: what all trials ask now is submitted together, and each answer goes to who waits for it.

A round is closed when nothing can go on before an answer comes, so that all trials advance by one
decision at a time, and a sweep takes as many rounds as its longest trial has decisions. A line that
failed is asked singly. The journal knows of a batch before its provider does: a call that waits in
an open batch is not asked anew, it joins those that wait there.
"""

from __future__ import annotations

import asyncio
import itertools
import math
import secrets
from collections import defaultdict
from collections.abc import Awaitable, Callable, Coroutine, Iterable, Sequence
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from functools import partial
from typing import TYPE_CHECKING, Any, TypeVar

from merge_runner.errors import (
    EndpointRefused,
    MergeRunnerError,
    ProviderDown,
    QuotaExhausted,
    TrialSuspended,
)
from merge_runner.llm.batch.journal import Journal, OpenBatch
from merge_runner.llm.batch.service import BatchFailed, BatchService
from merge_runner.llm.budget import Budget, PaidAttempt
from merge_runner.llm.http_outcome import RawReply, backoff_s
from merge_runner.records import Attempt

if TYPE_CHECKING:
    from merge_runner.llm.client import Call

# How often it is looked whether a round can be closed: what is seen then decides, not the time.
LOOK_S = 0.05
# A task that can go on shows that when the loop has come round once; a chain of them, soon after.
LOOKS = 5
# Fewer than any provider takes: one batch that is lost or late concerns no more calls.
MOST_CALLS = 5_000
SHORTEST_POLL_S, LONGEST_POLL_S, POLL_SHARE = 0.25, 60.0, 0.1
# A creation whose answer was lost may be in effect only after 30 s, since gateways keep requests:
# the pauses between looks.
ARRIVAL_S = (1.0, 1.0, 2.0, 4.0, 8.0, 14.0)
# How long a creation is tried again.
OUTAGE_S = 600.0
# How long a batch that has ended may take to show its results.
ENDING_S = 3600.0
T = TypeVar("T")


@dataclass(frozen=True, slots=True)
class LineEnd:
    """How a line ended.

    Without a ``raw`` reply ``outcome`` names why, and nothing was charged unless it is ``unclear``.
    Then it is asked singly. An ``error`` ends the sweep.
    """

    raw: RawReply | None = None
    outcome: str = ""
    message: str = ""
    unclear: bool = False
    error: MergeRunnerError | None = None


@dataclass(slots=True, eq=False)
class Line:
    """A call whose next attempt waits for a batch to be created, or to end.

    ``model`` is its name in the registry, ``batch`` will be the one that it goes to.
    """

    call: Call
    model: str
    paid: PaidAttempt
    batch: asyncio.Future[Batch] = field(init=False)

    @property
    def key(self) -> str:
        """That of its request, which is its id at the provider."""
        return self.call.request.key

    def begins(self) -> bool:
        """Set its money aside durably, unless that is done; False if the cap is used up."""
        return not self.paid.queued or self.paid.set_aside(self.call.attempts)


@dataclass(slots=True, eq=False)
class Batch:
    """A batch of this process, whose ``work`` ends with it.

    Then ``ends`` has the lines with a result, by key, until they are taken, and ``rest`` is the end
    of all others; None: they go with the next round. While its work ``sleeps`` nothing of it is on
    its way.
    """

    note: OpenBatch
    ends: dict[str, LineEnd] = field(default_factory=dict)
    rest: LineEnd | None = None
    sleeps: bool = False
    work: asyncio.Task[None] = field(init=False)

    @property
    def age_s(self) -> float:
        """How long ago it was submitted."""
        return (datetime.now(UTC) - self.note.submitted_at).total_seconds()

    async def sleep(self, seconds: float) -> None:
        """Wait, while others may go on."""
        self.sleeps = True
        await asyncio.sleep(seconds)
        self.sleeps = False


@dataclass(frozen=True, slots=True)
class Batches:
    """How one model, by its name in the registry, is asked in rounds, and with whose money."""

    rounds: Rounds
    model: str
    money: Budget
    price_factor: float

    def takes_up(self, call: Call) -> bool:
        """Whether a call waits in a batch already, so that its trial has begun."""
        if self.rounds.open_batch(call.request.key) is None:
            return False
        self.money.begin_anew(call.order)
        return True

    async def line(self, call: Call) -> Line:
        """Return the next attempt at a call with its money, which the caller closes."""
        asked = replace(call.asked, honest_usd=call.asked.honest_usd * self.price_factor)
        who = (call.order, call.request.key, asked)
        if call.open is None:
            with call.waiting("for calls in flight to be paid, under --max-cost", idle=True):
                paid = await self.money.set_aside(*who)
        else:
            paid = self.money.going_on(*who, call.open.ledger)
        return Line(call, self.model, paid)


class Rounds:
    """The rounds of a run; ``services`` are the batch modes of its models, by registered name.

    A run that does not ``submits`` takes only what earlier runs have submitted.
    """

    def __init__(
        self,
        journal: Journal,
        services: dict[str, BatchService],
        *,
        submits: bool,
        say: Callable[[str], None],
    ) -> None:
        self.submits = submits
        self.services = services
        self._journal = journal
        self._say = say
        self._forming: list[Line] = []
        self._batches: dict[str, Batch] = {}
        self._creations: set[asyncio.Task[None]] = set()
        # Models of which a batch was refused: the most calls of the next. They go one by one.
        self._most: dict[str, int] = {}

    def open_batch(self, key: str, attempts: Iterable[Attempt] = ()) -> OpenBatch | None:
        """Return where a call with these attempts waits; None: nowhere that can be reached."""
        batch = self._journal.batch_of(key)
        if batch is None or not batch.holds(key, attempts) or batch.model not in self.services:
            return None
        return batch

    async def ask(self, line: Line) -> tuple[LineEnd, OpenBatch]:
        """Wait for the end of a line, in the next round or in the batch where it waits already."""
        note = line.call.open
        batch = await self._next_round(line) if note is None else self._taken_up(note)
        while True:
            await asyncio.shield(batch.work)
            if line.key not in batch.note.lines:
                raise TrialSuspended("another run spends from the same cap, and has used it up")
            end = batch.ends.pop(line.key, batch.rest)
            if end is not None:
                return end, batch.note
            if not self.submits:
                end = LineEnd(outcome="not_created", message="the run ended before")
                return end, batch.note
            batch = await self._next_round(line)

    async def watch(self, is_idle: Callable[[], bool]) -> None:
        """Close each round when nothing else goes on; ``is_idle`` says whether that is so."""
        while True:
            await asyncio.sleep(LOOK_S)
            for _ in range(LOOKS):
                await asyncio.sleep(0)
                sleep = all(batch.sleeps for batch in self._open())
                if not (self._forming and sleep and is_idle()):
                    break
            else:
                self._close_round()

    def standing(self) -> list[str]:
        """Return which batches are waited for, a line each."""
        return [
            f"{len(note.lines)} calls of {note.model} wait in batch {note.batch_id or 'to be'} "
            f"since {note.submitted_at:%H:%M:%S} UTC"
            for note in (batch.note for batch in self._open())
        ]

    async def close(self) -> None:
        """End the waiting; batches that are being created get their ids noted first."""
        work = [batch.work for batch in self._batches.values()]
        for task in work:
            task.cancel()
        await asyncio.gather(*work, *self._creations, return_exceptions=True)
        await self._journal.tidy()

    def _open(self, model: str | None = None) -> list[Batch]:
        """Return the batches that have not ended: they take room at their provider."""
        every = self._batches.values()
        return [b for b in every if not b.work.done() and model in (None, b.note.model)]

    async def _next_round(self, line: Line) -> Batch:
        line.batch = asyncio.get_running_loop().create_future()
        self._forming.append(line)
        return await line.batch

    def _close_round(self) -> None:
        groups: defaultdict[tuple[str, str], list[Line]] = defaultdict(list)
        for line in self._forming:
            if not line.batch.done():  # somebody waits for it yet
                groups[line.model, line.paid.ledger.scope].append(line)
        self._forming = []
        for (model, ledger), lines in groups.items():
            most = self._most.get(model, MOST_CALLS)
            parts = [lines[at : at + most] for at in range(0, len(lines), most)]
            if model in self._most:
                later = parts if self._open(model) else parts[1:]
                parts = parts[: len(parts) - len(later)]
                self._forming += itertools.chain.from_iterable(later)
            for part in parts:
                note = OpenBatch(
                    mark=secrets.token_hex(16),
                    model=model,
                    ledger=ledger,
                    submitted_at=datetime.now(UTC),
                    lines={line.key: len(line.call.attempts) + 1 for line in part},
                )
                batch = Batch(note)
                self._start(batch, self._submit(batch, part))
                for line in part:
                    line.batch.set_result(batch)

    def _start(self, batch: Batch, work: Coroutine[Any, Any, None]) -> None:
        """Do something for a batch in a task of its own; what it raises is raised for its lines."""

        async def do() -> None:
            try:
                await work
            except BatchFailed as exc:
                self._lost(batch, exc)

        batch.work = asyncio.create_task(do())
        self._batches[batch.note.mark] = batch

    def _taken_up(self, note: OpenBatch) -> Batch:
        """Go on with a batch that an earlier run has submitted, or was about to."""

        async def go_on() -> None:
            if not note.batch_id and not self.services[note.model].takes_mark:
                why = "the run ended before its id was known"
                batch.rest = LineEnd(outcome="batch_lost", message=why, unclear=True)
            elif note.batch_id or await self._arrived(batch):
                await self._follow(batch)

        if note.mark not in self._batches:
            batch = Batch(note)
            self._start(batch, go_on())
        return self._batches[note.mark]

    async def _submit(self, batch: Batch, lines: Sequence[Line]) -> None:
        """Note a batch with those of its lines that may begin, create it, and follow it."""
        by_key = {line.key: line for line in lines}
        batch.note = await self._journal.begin(batch.note, lambda key: by_key[key].begins())
        begun = [by_key[key] for key in batch.note.lines]
        for line in begun:
            if line.paid.queued:
                line.paid.begun()
        if not begun:
            return
        try:
            await self._patiently(batch, partial(self._create, batch, begun), OUTAGE_S)
        except BatchFailed as exc:
            model = batch.note.model
            if exc.kind == "lost" and not self.services[model].takes_mark:
                batch.rest = LineEnd(None, "batch_lost", str(exc), unclear=True)
            elif exc.kind in ("again", "lost"):
                # It may be there all the same: the next run looks for it, and nothing is settled.
                raise ProviderDown(
                    f"{model}: no batch can be submitted ({exc}): nothing else is asked. "
                    "When the service answers again, run the same command"
                ) from exc
            else:
                await self._not_asked(batch, exc, "not_created")
        else:
            await self._follow(batch)

    async def _create(self, batch: Batch, lines: Sequence[Line]) -> None:
        """Create a batch; where its answer is lost, look for it."""
        service = self.services[batch.note.model]

        async def create() -> None:
            requests = [line.call.request for line in lines]
            await self._note(batch, await service.create(requests, batch.note.mark))

        creation = asyncio.create_task(create())
        self._creations.add(creation)
        creation.add_done_callback(self._creations.discard)
        try:
            await asyncio.shield(creation)  # its id is noted even if the run ends now
        except BatchFailed as exc:
            if exc.sent and not service.takes_mark:
                raise BatchFailed("lost", f"whether it was created is not known ({exc})") from exc
            if not (exc.sent and await self._arrived(batch)):
                raise

    async def _arrived(self, batch: Batch) -> bool:
        """Look for a batch until its creation, if it was ever sent, must be in effect."""
        find = partial(self.services[batch.note.model].find, batch.note.mark)
        for pause_s in (0.0, *ARRIVAL_S):
            await batch.sleep(pause_s)
            if (batch_id := await self._patiently(batch, find)) is not None:
                await self._note(batch, batch_id)
                return True
        return False

    async def _note(self, batch: Batch, batch_id: str) -> None:
        batch.note = batch.note.model_copy(update={"batch_id": batch_id})
        await self._journal.note(batch.note)

    async def _follow(self, batch: Batch) -> None:
        """Wait for the end of a batch, and read its results until no more can be had."""
        note, message = batch.note, "the batch has ended without a result for it"
        ask = partial(self.services[note.model].status, note.batch_id)
        while not (status := await self._patiently(batch, ask)).ended and not status.failure:
            pause_s = min(LONGEST_POLL_S, POLL_SHARE * batch.age_s)
            await batch.sleep(max(SHORTEST_POLL_S, pause_s))
        if status.failure:
            await self._not_asked(batch, status.failure, "batch_failed")
            return
        try:
            await self._patiently(batch, partial(self._read, batch), ENDING_S)
        except BatchFailed as exc:
            if exc.kind != "again":
                raise
            message = str(exc)
        batch.rest = LineEnd(outcome="no_result", message=message, unclear=True)
        if note.model in self._most:
            self._most[note.model] = max(self._most[note.model], 2 * len(note.lines))

    async def _read(self, batch: Batch) -> None:
        """Take the results of a batch; raises BatchFailed where there should be others."""
        note, service = batch.note, self.services[batch.note.model]
        status = await service.status(note.batch_id)
        if not status.ended:
            raise BatchFailed("again", "a batch that has ended is said to go on")
        foreign = broken = 0
        async for key, raw in service.results(note.batch_id, status):
            end = LineEnd(raw) if raw else LineEnd(None, "expired", "it was not asked in time")
            broken += not key
            foreign += bool(key) and (
                key not in note.lines or batch.ends.setdefault(key, end) != end
            )
        if broken or foreign:
            self._say(
                f"{note.model}: {broken + foreign} results of batch {note.batch_id} are ignored: "
                "they are broken, of none of its calls, or differ from an earlier one"
            )
        if len(batch.ends) + broken < min(status.results, len(note.lines)):
            raise BatchFailed(
                "again", f"{len(batch.ends)} of the {status.results} results are there"
            )

    async def _not_asked(self, batch: Batch, exc: BatchFailed, outcome: str) -> None:
        """End a batch of which the provider asks no line, or let its lines go in smaller ones."""
        model, calls = batch.note.model, len(batch.note.lines)
        is_alone = self._open(model) == [batch]
        error: MergeRunnerError | None = None
        if exc.kind in ("quota", "refused"):
            kind = QuotaExhausted if exc.kind == "quota" else EndpointRefused
            error = kind(
                f"{model}: its batch mode refuses: {exc}. Every reply so far is saved: correct "
                "that, or leave --batch out, and run the same command to go on"
            )
        elif is_alone and calls == 1:
            self._say(f"{model}: a call is asked singly, at the full price ({exc})")
        else:
            if model not in self._most:
                self._say(f"{model}: {calls} calls go in smaller batches: {exc}")
            self._most[model] = max(1, calls // 2) if is_alone else calls
            # It counts as open, so that no other one is submitted meanwhile.
            await batch.sleep(exc.delay_s or 1.0)
            return
        batch.rest = LineEnd(None, outcome, str(exc), error=error)

    def _lost(self, batch: Batch, exc: BatchFailed) -> None:
        """End a batch that cannot be read: what was set aside for it stays so."""
        note = batch.note
        # A key that is refused is another account's, perhaps: there the batch goes on.
        if self.services[note.model].forgets or (not self.submits and exc.kind == "lost"):
            batch.rest = LineEnd(outcome="batch_lost", message=str(exc), unclear=True)
            return
        raise EndpointRefused(
            f"{note.model}: {note.batch_id} is refused to this key ({exc}): set the key of the "
            "account that has submitted it. If it is gone, the same command without --batch asks "
            "its calls anew"
        ) from exc

    async def _patiently(
        self, batch: Batch, ask: Callable[[], Awaitable[T]], patience_s: float = math.inf
    ) -> T:
        """Ask until a provider answers that may only be down; raises BatchFailed for anything else.

        A batch waits for a day: whoever waits for it can wait for its provider.
        """
        clock_s = asyncio.get_running_loop().time
        began_s, tries = clock_s(), 0
        while True:
            try:
                return await ask()
            except BatchFailed as exc:
                if exc.kind != "again" or clock_s() - began_s > patience_s:
                    raise
                if not tries:
                    self._say(f"{batch.note.model}: {exc}; it is asked again until it answers")
                tries += 1
                await batch.sleep(max(exc.delay_s or 0.0, backoff_s(tries)))
