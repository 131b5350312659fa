"""Lifecycle of a batch: submit it, or find it again; poll it; read its results.

A batch is noted in the cache before its provider knows of it. So after a kill the
next process knows the batch to find, or to wait for, and the number of each call's attempt in it.
"""

from __future__ import annotations

import asyncio
import math
from collections.abc import Awaitable, Callable, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from functools import partial
from typing import TypeVar

from merge_runner.errors import EndpointRefused, ProviderDown, QuotaExhausted, TrialSuspended
from merge_runner.llm.batch.notes import PREFIX, Batch, BatchRequest
from merge_runner.llm.batch.service import BatchFailed, BatchService, BatchStatus
from merge_runner.llm.cache import ResponseCache
from merge_runner.llm.delays import backoff_s
from merge_runner.llm.http_outcome import AttemptOutcome, judge
from merge_runner.records import ChatRequest

SHORTEST_POLL_S, LONGEST_POLL_S, POLL_SHARE = 0.25, 60.0, 0.1
# Pauses between the attempts to find a batch: a gateway may keep its creation for up to 30 s.
ARRIVAL_S = (1.0, 1.0, 2.0, 4.0, 8.0, 14.0)
# How long a creation is retried.
OUTAGE_S = 600.0
# How long a batch that has ended may take to show its results.
ENDING_S = 3600.0
T = TypeVar("T")


@dataclass
class Lifecycle:
    """Submission of the batches of a run, and their course up to the end.

    ``services`` has the batch modes by model, ``batches`` all that calls wait in, by mark.
    ``max_calls`` is set for a model after its provider has rejected a batch as too large; such a
    model has one open batch at a time. Unless it ``submits``, a run only follows.
    """

    cache: ResponseCache
    batches: dict[str, Batch]
    say: Callable[[str], None]
    submits: bool
    services: dict[str, BatchService] = field(default_factory=dict)
    max_calls: dict[str, int] = field(default_factory=dict)

    def start(self, batch: Batch, requests: Sequence[BatchRequest] = ()) -> asyncio.Task[None]:
        """Submit requests, or resume a batch that an earlier run has noted; return the task.

        An error of the task is raised for each call that waits for the batch.
        """

        async def work() -> None:
            try:
                if requests:
                    begun = await self._begin(batch, requests)
                    exists = bool(begun) and await self._submit(batch, begun)
                else:
                    exists = bool(batch.note.batch_id) or await self._find_created(batch)
                if exists:
                    await self._follow(batch)
            except BatchFailed as exc:
                self._on_unknown_fate(batch, exc)

        batch.work = asyncio.create_task(work())
        return batch.work

    def open_batches(self, model: str | None = None) -> list[Batch]:
        """Return the batches that have not ended: they take room at their provider."""
        return [
            batch
            for batch in self.batches.values()
            if (work := batch.work) and model in (None, batch.note.model)
            # A batch whose task was cancelled goes on at its provider.
            if work.cancelled() or not work.done()
        ]

    async def _begin(self, batch: Batch, requests: Sequence[BatchRequest]) -> list[ChatRequest]:
        """Begin the reservations and note the batch with the requests that have money."""
        begun = []

        async def begin(attempt: BatchRequest) -> None:
            try:
                await attempt.reservation.begin(attempt.number)
                begun.append(attempt.request)
            except TrialSuspended as exc:
                batch.suspended[attempt.request.key] = exc

        await asyncio.gather(*map(begin, requests))
        await self._note(batch, lines={r.key: batch.note.lines[r.key] for r in begun})
        return begun

    async def _submit(self, batch: Batch, requests: Sequence[ChatRequest]) -> bool:
        """Create a batch, or find it where the reply is lost; False if it is not created."""
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
                if not (exc.sent and await self._find_created(batch)):
                    raise

        try:
            await self._retry_transient(batch, created, OUTAGE_S)
        except BatchFailed as exc:
            await self._on_rejected(batch, exc, "not_created")
            return False
        return True

    async def _find_created(self, batch: Batch) -> bool:
        """Look for a batch until its creation, if it was ever sent, must have taken effect."""
        service = self.services[batch.note.model]
        if not service.takes_mark:
            raise BatchFailed("lost", "whether it was created is not known")
        find = partial(service.find, batch.note.mark)
        for pause_s in (0.0, *ARRIVAL_S):
            await asyncio.sleep(pause_s)
            if (batch_id := await self._retry_transient(batch, find)) is not None:
                await self._note(batch, batch_id=batch_id)
                return True
        return False

    async def _note(self, batch: Batch, **changes: object) -> None:
        batch.note = note = batch.note.model_copy(update=changes)
        text = note.model_dump_json()
        await self.cache.write(partial(self.cache.replace, PREFIX + note.mark, text))

    async def _follow(self, batch: Batch) -> None:
        """Wait for the end of a batch, and read its results until no more can be had."""
        note = batch.note
        status_of = partial(self.services[note.model].status, note.batch_id)
        while (status := await self._retry_transient(batch, status_of)) == BatchStatus():
            age_s = (datetime.now(UTC) - note.submitted_at).total_seconds()
            await asyncio.sleep(max(SHORTEST_POLL_S, min(LONGEST_POLL_S, POLL_SHARE * age_s)))
        if status.failure:
            await self._on_rejected(batch, status.failure, "batch_failed")
            return
        try:
            await self._retry_transient(batch, partial(self._read, batch), ENDING_S)
        except BatchFailed as exc:
            if exc.kind != "again":
                raise
        batch.default = no_result("no_result", "the batch has ended without a result for it")
        if note.model in self.max_calls:
            self.max_calls[note.model] = max(self.max_calls[note.model], 2 * len(note.lines))

    async def _read(self, batch: Batch) -> None:
        """Read the results of a batch; raise BatchFailed where results are missing."""
        note, service, broken = batch.note, self.services[batch.note.model], 0
        status = await service.status(note.batch_id)  # which may name more files than before
        async for key, raw in service.results(status.paths or []):
            outcome = no_result("expired", "it was not asked in time", charged=False)
            if raw:  # a rate limit for batches pauses no normal request
                outcome = judge(raw, service.wire)._replace(pause=False, delay_s=None)
            broken += not key
            if key in note.lines:  # others are of other batches; the first of two counts
                batch.results.setdefault(key, outcome)
        number = len(batch.results) + broken
        if status.paths is None or number < min(status.results, len(note.lines)):
            raise BatchFailed("again", f"{number} of the {status.results} results are there")

    async def _on_rejected(self, batch: Batch, exc: BatchFailed, outcome: str) -> None:
        """End a batch that was not processed, or let its requests go in smaller ones."""
        model, calls = batch.note.model, len(batch.note.lines)
        is_only = self.open_batches(model) == [batch]
        if exc.kind == "lost":
            raise exc
        if exc.kind == "again" and outcome == "not_created":
            # It may exist all the same: the next run looks for it, and nothing is booked.
            raise ProviderDown(
                f"{model}: no batch can be submitted ({exc}): nothing else is asked. When the "
                "service answers again, run the same command"
            )
        if exc.kind in ("quota", "rejected"):
            kind = QuotaExhausted if exc.kind == "quota" else EndpointRefused
            batch_id = batch.note.batch_id and f" batch {batch.note.batch_id}"
            batch.error = kind(
                f"{model}: its batch mode refuses{batch_id}: {exc}. Every reply so far is saved: "
                "correct that, or leave --batch out, and run the same command to go on"
            )
        elif calls > 1 or not is_only:
            if model not in self.max_calls:
                self.say(f"{model}: {calls} calls go in smaller batches: {exc}")
            self.max_calls[model] = max(1, calls // 2) if is_only else calls
            # It counts as open, so that no other one is submitted meanwhile.
            await asyncio.sleep(exc.delay_s or 1.0)
            return
        batch.default = no_result(outcome, str(exc), charged=False)

    def _on_unknown_fate(self, batch: Batch, exc: BatchFailed) -> None:
        """End a batch that cannot be read: its reservations stay."""
        note = batch.note
        can_be_found = note.batch_id or self.services[note.model].takes_mark
        # Another account's key may be refused a batch that goes on.
        if can_be_found and (self.submits or exc.kind != "lost"):
            raise EndpointRefused(
                f"{note.model}: batch {note.batch_id or note.mark} is refused to this key ({exc}): "
                "set the key of the account that submitted it. If it is gone, the same command "
                "without --batch asks its calls anew"
            ) from exc
        batch.default = no_result("batch_lost", str(exc))

    async def _retry_transient(
        self, batch: Batch, ask: Callable[[], Awaitable[T]], patience_s: float = math.inf
    ) -> T:
        """Retry while the provider may only be down; raise BatchFailed for anything else.

        A batch takes up to a day, so an outage of its provider is waited for.
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
                    self.say(f"{batch.note.model}: {exc}; it is asked again until it answers")
                tries += 1
                await asyncio.sleep(max(exc.delay_s or 0.0, backoff_s(tries)))


def no_result(name: str, why: str, *, charged: bool = True) -> AttemptOutcome:
    """Return the outcome of a request without a result: a normal request follows."""
    return AttemptOutcome("retry", name, why, charged=charged)
