"""Rounds: what all trials ask now is submitted together, and each answer goes to who waits for it.

A round is closed when nothing can go on before an answer comes, so that all trials advance by one
decision at a time, and a sweep takes as many rounds as its longest trial has decisions. A line that
failed is asked singly.

A batch is noted in the cache before its provider knows of it. A process that is killed leaves there
what the next one needs: the batch to look for, or to wait for, and under which of its attempts each
call waits there. A call that waits in an open batch is not asked anew, it joins those that wait
there. One process at a time asks a model in a cache, so that it knows all notes of its models once
it has read them.
"""

from __future__ import annotations

import asyncio
import contextlib
import itertools
import math
import secrets
from collections import defaultdict
from collections.abc import Awaitable, Callable, Collection, Sequence
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from functools import partial
from typing import TypeVar

from pydantic import AwareDatetime, BaseModel, ValidationError

from merge_runner.errors import (
    EndpointRefused,
    MergeRunnerError,
    ProviderDown,
    QuotaExhausted,
    RecordingError,
    TrialSuspended,
)
from merge_runner.llm.batch.service import BatchFailed, BatchService, BatchStatus
from merge_runner.llm.budget import USED_UP, PaidAttempt
from merge_runner.llm.cache import ResponseCache
from merge_runner.llm.delays import backoff_s
from merge_runner.llm.http_outcome import AttemptOutcome, judge
from merge_runner.records import ChatRequest

# The prefix of names in the cache.
_BATCH = "batch "
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


class OpenBatch(BaseModel, frozen=True):
    """What is noted of a batch that was created, or is about to be.

    ``mark`` is its name at the provider, ``batch_id`` its id, empty until the provider has told it.
    ``lines`` has the number of the attempt by the key of each call. ``model`` is its name in the
    registry. ``number`` counts the batches noted in a cache, since a clock may be set back between
    two of them; it is 0 in notes of versions that did not count. ``submitted_at`` is UTC.
    """

    mark: str
    model: str
    number: int = 0
    submitted_at: AwareDatetime
    lines: dict[str, int]
    batch_id: str = ""


@dataclass(slots=True, eq=False)
class Batch:
    """A batch, whose ``work`` ends with it; None where nobody has asked for a call of it yet.

    Then ``ends`` has what became of the lines with a result, by key, until it is taken, and
    ``rest`` what became of all others; None: they go with the next round. An ``error`` ends the
    sweep.
    """

    note: OpenBatch
    ends: dict[str, AttemptOutcome] = field(default_factory=dict)
    rest: AttemptOutcome | None = None
    error: MergeRunnerError | None = None
    work: asyncio.Task[None] | None = None


@dataclass(slots=True, eq=False)
class Line:
    """An attempt that waits for a batch; ``batch`` will be the one that it goes to."""

    request: ChatRequest
    number: int
    paid: PaidAttempt
    model: str
    batch: asyncio.Future[Batch]


class Rounds:
    """The rounds of a run; ``services`` are the batch modes of its models, by registered name.

    A run that does not ``submits`` takes only what earlier runs have submitted. ``batches`` are
    all that calls of its ``models`` wait in, by mark, the oldest first.
    """

    def __init__(
        self,
        cache: ResponseCache,
        models: Collection[str],
        *,
        submits: bool,
        say: Callable[[str], None],
    ) -> None:
        self.services: dict[str, BatchService] = {}
        self.submits = submits
        self._cache = cache
        self._say = say
        self._forming: list[Line] = []
        # Models of which a batch was refused: the most calls of the next. They go one by one.
        self._most: dict[str, int] = {}
        noted = []
        for name in cache.names(_BATCH):
            with contextlib.suppress(RecordingError, ValidationError):  # a damaged one is none
                noted.append(OpenBatch.model_validate_json(cache.read(name) or ""))
        noted.sort(key=lambda note: (note.number, note.submitted_at))
        self._numbers = itertools.count(1 + max((note.number for note in noted), default=0))
        self.batches = {note.mark: Batch(note) for note in noted if note.model in models}
        # Where earlier runs have submitted calls last whose attempts there have not ended.
        self.waiting: dict[str, Batch] = {}
        for batch in self.batches.values():
            self.waiting |= dict.fromkeys(batch.note.lines, batch)
        self.waiting = {key: b for key, b in self.waiting.items() if not self._ended(key, b)}
        ended = self.batches.keys() - {batch.note.mark for batch in self.waiting.values()}
        cache.run_now([partial(cache.remove, _BATCH + mark) for mark in ended])
        for mark in ended:
            del self.batches[mark]

    async def ask(
        self, request: ChatRequest, number: int, paid: PaidAttempt, model: str, batch: Batch | None
    ) -> tuple[AttemptOutcome, Batch]:
        """Return what became of an attempt, in the ``batch`` where it waits or the next round."""
        batch = batch or await self._next_round(request, number, paid, model)
        while True:
            await asyncio.shield(batch.work or self._start(batch))
            if request.key not in batch.note.lines:
                raise TrialSuspended(USED_UP)
            end = batch.ends.pop(request.key, batch.rest)
            if end is None and not self.submits:
                end = _no_answer("not_created", "the run ended before", charged=False)
            if end is not None:
                self.waiting.pop(request.key, None)
                return end, batch
            batch = await self._next_round(request, number, paid, model)

    async def watch(self, is_idle: Callable[[], bool]) -> None:
        """Close each round when nothing else goes on; ``is_idle`` says whether that is so."""
        while True:
            await asyncio.sleep(LOOK_S)
            for _ in range(LOOKS):
                await asyncio.sleep(0)
                if not (self._forming and is_idle()):
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
        work = [batch.work for batch in self.batches.values() if batch.work]
        for task in work:
            task.cancel()
        await asyncio.gather(*work, return_exceptions=True)

    def _open(self, model: str | None = None) -> list[Batch]:
        """Return the batches that have not ended: they take room at their provider."""
        return [
            batch
            for batch in self.batches.values()
            if (work := batch.work) and model in (None, batch.note.model)
            # One whose work was cancelled goes on without this run.
            if work.cancelled() or not work.done()
        ]

    def _ended(self, key: str, batch: Batch) -> bool:
        with contextlib.suppress(RecordingError):  # damaged: nothing is known of its attempts
            entry, attempts = self._cache.look_up(key)
            outcomes = {each.number: each.outcome for each in attempts}
            return entry is not None or outcomes.get(batch.note.lines[key], "unknown") != "unknown"
        return False

    async def _next_round(
        self, request: ChatRequest, number: int, paid: PaidAttempt, model: str
    ) -> Batch:
        line = Line(request, number, paid, model, asyncio.get_running_loop().create_future())
        self._forming.append(line)
        return await line.batch

    def _close_round(self) -> None:
        groups: defaultdict[str, list[Line]] = defaultdict(list)
        for line in self._forming:
            if not line.batch.done():  # somebody waits for it yet
                groups[line.model].append(line)
        self._forming = []
        for model, lines in groups.items():
            most = self._most.get(model, MOST_CALLS)
            if model in self._most:
                now = 0 if self._open(model) else most
                self._forming += lines[now:]
                del lines[now:]
            for part in (lines[at : at + most] for at in range(0, len(lines), most)):
                note = OpenBatch(
                    mark=secrets.token_hex(16),
                    model=model,
                    number=next(self._numbers),
                    submitted_at=datetime.now(UTC),
                    lines={each.request.key: each.number for each in part},
                )
                batch = self.batches[note.mark] = Batch(note)
                self._start(batch, part)
                for line in part:
                    line.batch.set_result(batch)

    def _start(self, batch: Batch, lines: Sequence[Line] = ()) -> asyncio.Task[None]:
        """Submit lines, or go on with a batch that an earlier run has submitted, or was about to.

        That is a task of its own; what it raises is raised for all who wait for it.
        """

        async def work() -> None:
            try:
                if lines:
                    requests = await self._begin(batch, lines)
                    is_there = bool(requests) and await self._submit(batch, requests)
                else:
                    is_there = bool(batch.note.batch_id) or await self._arrived(batch)
                if is_there:
                    await self._follow(batch)
            except BatchFailed as exc:
                self._lost(batch, exc)

        batch.work = asyncio.create_task(work())
        return batch.work

    async def _begin(self, batch: Batch, lines: Sequence[Line]) -> list[ChatRequest]:
        """Set the money of lines aside, and note a batch with those that have some.

        Returns their requests.
        """
        begun = []

        async def begin(line: Line) -> None:
            with contextlib.suppress(TrialSuspended):
                await line.paid.begin(line.number)
                begun.append(line.request)

        await asyncio.gather(*map(begin, lines))
        await self._note(batch, lines={each.key: batch.note.lines[each.key] for each in begun})
        return begun

    async def _submit(self, batch: Batch, requests: Sequence[ChatRequest]) -> bool:
        """Create a batch, or find it where the answer is lost; False if it is not created."""
        service = self.services[batch.note.model]

        async def create() -> None:
            await self._note(batch, batch_id=await service.create(requests, batch.note.mark))

        async def created() -> None:
            creation = asyncio.create_task(create())
            try:
                await asyncio.shield(creation)
            except asyncio.CancelledError:
                await asyncio.wait([creation])  # its id is noted even if the run ends now
                raise
            except BatchFailed as exc:
                if not (exc.sent and await self._arrived(batch)):
                    raise

        try:
            await self._patiently(batch, created, OUTAGE_S)
        except BatchFailed as exc:
            await self._not_asked(batch, exc, "not_created")
            return False
        return True

    async def _arrived(self, batch: Batch) -> bool:
        """Look for a batch until its creation, if it was ever sent, must be in effect."""
        service = self.services[batch.note.model]
        if not service.takes_mark:
            raise BatchFailed("lost", "whether it was created is not known")
        find = partial(service.find, batch.note.mark)
        for pause_s in (0.0, *ARRIVAL_S):
            await asyncio.sleep(pause_s)
            if (batch_id := await self._patiently(batch, find)) is not None:
                await self._note(batch, batch_id=batch_id)
                return True
        return False

    async def _note(self, batch: Batch, **changes: object) -> None:
        batch.note = note = batch.note.model_copy(update=changes)
        text = note.model_dump_json()
        await self._cache.write(partial(self._cache.replace, _BATCH + note.mark, text))

    async def _follow(self, batch: Batch) -> None:
        """Wait for the end of a batch, and read its results until no more can be had."""
        note = batch.note
        ask = partial(self.services[note.model].status, note.batch_id)
        while (status := await self._patiently(batch, ask)) == BatchStatus():
            age_s = (datetime.now(UTC) - note.submitted_at).total_seconds()
            await asyncio.sleep(max(SHORTEST_POLL_S, min(LONGEST_POLL_S, POLL_SHARE * age_s)))
        if status.failure:
            await self._not_asked(batch, status.failure, "batch_failed")
            return
        try:
            await self._patiently(batch, partial(self._read, batch), ENDING_S)
        except BatchFailed as exc:
            if exc.kind != "again":
                raise
        batch.rest = _no_answer("no_result", "the batch has ended without a result for it")
        if note.model in self._most:
            self._most[note.model] = max(self._most[note.model], 2 * len(note.lines))

    async def _read(self, batch: Batch) -> None:
        """Take the results of a batch; raises BatchFailed where there should be others."""
        note, service, broken = batch.note, self.services[batch.note.model], 0
        status = await service.status(note.batch_id)  # which may name more files than before
        async for key, raw in service.results(status.paths or []):
            end = _no_answer("expired", "it was not asked in time", charged=False)
            if raw:  # no limit of single calls is meant, and no call waits for one
                end = replace(judge(raw, service.wire), pause=False, delay_s=None)
            broken += not key
            if key in note.lines:  # others are of other batches; of two the first counts
                batch.ends.setdefault(key, end)
        there = len(batch.ends) + broken
        if status.paths is None or there < min(status.results, len(note.lines)):
            raise BatchFailed("again", f"{there} of the {status.results} results are there")

    async def _not_asked(self, batch: Batch, exc: BatchFailed, outcome: str) -> None:
        """End a batch of which the provider asks no line, or let its lines go in smaller ones."""
        model, calls = batch.note.model, len(batch.note.lines)
        is_alone = self._open(model) == [batch]
        if exc.kind == "lost":
            raise exc
        if exc.kind == "again" and outcome == "not_created":
            # It may be there all the same: the next run looks for it, and nothing is settled.
            raise ProviderDown(
                f"{model}: no batch can be submitted ({exc}): nothing else is asked. When the "
                "service answers again, run the same command"
            )
        if exc.kind in ("quota", "refused"):
            kind = QuotaExhausted if exc.kind == "quota" else EndpointRefused
            batch_id = batch.note.batch_id and f" batch {batch.note.batch_id}"
            batch.error = kind(
                f"{model}: its batch mode refuses{batch_id}: {exc}. Every reply so far is saved: "
                "correct that, or leave --batch out, and run the same command to go on"
            )
        elif calls > 1 or not is_alone:
            if model not in self._most:
                self._say(f"{model}: {calls} calls go in smaller batches: {exc}")
            self._most[model] = max(1, calls // 2) if is_alone else calls
            # It counts as open, so that no other one is submitted meanwhile.
            await asyncio.sleep(exc.delay_s or 1.0)
            return
        batch.rest = _no_answer(outcome, str(exc), charged=False)

    def _lost(self, batch: Batch, exc: BatchFailed) -> None:
        """End a batch that cannot be read: what was set aside for it stays so."""
        note = batch.note
        can_be_found = note.batch_id or self.services[note.model].takes_mark
        # A key that is refused is another account's, perhaps: there the batch goes on.
        if can_be_found and (self.submits or exc.kind != "lost"):
            raise EndpointRefused(
                f"{note.model}: batch {note.batch_id or note.mark} is refused to this key ({exc}): "
                "set that of the account that has submitted it. If it is gone, the same command "
                "without --batch asks its calls anew"
            ) from exc
        batch.rest = _no_answer("batch_lost", str(exc))

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
                await asyncio.sleep(max(exc.delay_s or 0.0, backoff_s(tries)))


def _no_answer(name: str, why: str, *, charged: bool = True) -> AttemptOutcome:
    """Return what became of a line without a result, which is asked singly."""
    return AttemptOutcome("retry", name, why, charged=charged)
