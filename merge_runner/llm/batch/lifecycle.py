"""Batches, each with its course: submit it, or find it again; poll it; read its results.

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
from typing import TYPE_CHECKING, TypeVar

from pydantic import AwareDatetime, BaseModel

from merge_runner.errors import (
    EndpointRefused,
    MergeRunnerError,
    ProviderDown,
    QuotaExhausted,
    TrialSuspended,
)
from merge_runner.llm.batch.service import BatchFailed, BatchService, BatchStatus
from merge_runner.llm.budget import Reservation
from merge_runner.llm.delays import backoff_s
from merge_runner.llm.http_outcome import AttemptOutcome, judge
from merge_runner.records import ChatRequest

if TYPE_CHECKING:
    from merge_runner.llm.batch.rounds import Rounds

# The prefix of the notes' names in the cache.
PREFIX = "batch "

SHORTEST_POLL_S, LONGEST_POLL_S, POLL_SHARE = 0.25, 60.0, 0.1
# Pauses between the attempts to find a batch: a gateway may keep its creation for up to 30 s.
ARRIVAL_S = (1.0, 1.0, 2.0, 4.0, 8.0, 14.0)
# How long a creation is retried.
OUTAGE_S = 600.0
# How long a batch that has ended may take to show its results.
ENDING_S = 3600.0
T = TypeVar("T")


class BatchNote(BaseModel, frozen=True):
    """Note of a batch that was created, or is about to be.

    ``mark`` is its name at the provider, ``batch_id`` its id there, empty until it is known.
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
    """A batch of a run, and its results.

    ``work`` follows it to its end; None: no call of this run waits for it yet. ``results`` has the
    outcomes that are not taken yet, by key. All other requests have ``default``; None: they
    go into the next round. ``suspended`` has, by key, why no money was reserved for a request.
    An ``error`` ends the sweep.
    """

    rounds: Rounds
    note: BatchNote
    results: dict[str, AttemptOutcome] = field(default_factory=dict)
    default: AttemptOutcome | None = None
    suspended: dict[str, TrialSuspended] = field(default_factory=dict)
    error: MergeRunnerError | None = None
    work: asyncio.Task[None] | None = None

    @property
    def _service(self) -> BatchService:
        return self.rounds.services[self.note.model]

    def start(self, requests: Sequence[BatchRequest] = ()) -> asyncio.Task[None]:
        """Submit requests, or resume a batch that an earlier run has noted; return ``work``.

        An error of the task is raised for each call that waits for the batch.
        """
        self.work = asyncio.create_task(self._work(requests))
        return self.work

    async def _work(self, requests: Sequence[BatchRequest]) -> None:
        try:
            if requests:
                begun = await self._begin(requests)
                exists = bool(begun) and await self._submit(begun)
            else:
                exists = bool(self.note.batch_id) or await self._find_created()
            if exists:
                await self._follow()
        except BatchFailed as exc:
            self._on_unknown_fate(exc)

    async def _begin(self, requests: Sequence[BatchRequest]) -> list[ChatRequest]:
        """Begin the reservations and note the batch with the requests that have money."""
        begun = []

        async def begin(attempt: BatchRequest) -> None:
            try:
                await attempt.reservation.begin(attempt.number)
                begun.append(attempt.request)
            except TrialSuspended as exc:
                self.suspended[attempt.request.key] = exc

        await asyncio.gather(*map(begin, requests))
        await self._change_note(lines={r.key: self.note.lines[r.key] for r in begun})
        return begun

    async def _submit(self, requests: Sequence[ChatRequest]) -> bool:
        """Create a batch, or find it where the reply is lost; False if it is not created."""

        async def create() -> None:
            batch_id = await self._service.create(requests, self.note.mark)
            await self._change_note(batch_id=batch_id)

        async def created() -> None:
            creation = asyncio.create_task(create())
            try:
                await asyncio.shield(creation)
            except asyncio.CancelledError:
                await asyncio.wait([creation])  # its id is noted even if the run ends now
                raise
            except BatchFailed as exc:
                if not (exc.sent and await self._find_created()):
                    raise

        try:
            await self._retry_transient(created, OUTAGE_S)
        except BatchFailed as exc:
            await self._on_rejected(exc, "not_created")
            return False
        return True

    async def _find_created(self) -> bool:
        """Look for a batch until its creation, if it was ever sent, must have taken effect."""
        if not self._service.takes_mark:
            raise BatchFailed("lost", "whether it was created is not known")
        find = partial(self._service.find, self.note.mark)
        for pause_s in (0.0, *ARRIVAL_S):
            await asyncio.sleep(pause_s)
            if (batch_id := await self._retry_transient(find)) is not None:
                await self._change_note(batch_id=batch_id)
                return True
        return False

    async def _change_note(self, **changes: object) -> None:
        self.note = self.note.model_copy(update=changes)
        name, text, cache = PREFIX + self.note.mark, self.note.model_dump_json(), self.rounds.cache
        await cache.write(partial(cache.replace, name, text))

    async def _follow(self) -> None:
        """Wait for the end of a batch, and read its results until no more can be had."""
        model, max_calls = self.note.model, self.rounds.max_calls
        status_of = partial(self._service.status, self.note.batch_id)
        while (status := await self._retry_transient(status_of)) == BatchStatus():
            age_s = (datetime.now(UTC) - self.note.submitted_at).total_seconds()
            await asyncio.sleep(max(SHORTEST_POLL_S, min(LONGEST_POLL_S, POLL_SHARE * age_s)))
        if status.failure:
            await self._on_rejected(status.failure, "batch_failed")
            return
        try:
            await self._retry_transient(self._read, ENDING_S)
        except BatchFailed as exc:
            if exc.kind != "again":
                raise
        self.default = no_result("no_result", "the batch has ended without a result for it")
        if model in max_calls:
            max_calls[model] = max(max_calls[model], 2 * len(self.note.lines))

    async def _read(self) -> None:
        """Read the results of a batch; raise BatchFailed where results are missing."""
        note, service, broken = self.note, self._service, 0
        status = await service.status(note.batch_id)  # which may name more files than before
        async for key, raw in service.results(status.paths or []):
            outcome = no_result("expired", "it was not asked in time", charged=False)
            if raw:  # a rate limit for batches pauses no normal request
                outcome = judge(raw, service.wire)._replace(pause=False, delay_s=None)
            broken += not key
            if key in note.lines:  # others are of other batches; the first of two counts
                self.results.setdefault(key, outcome)
        number = len(self.results) + broken
        if status.paths is None or number < min(status.results, len(note.lines)):
            raise BatchFailed("again", f"{number} of the {status.results} results are there")

    async def _on_rejected(self, exc: BatchFailed, outcome: str) -> None:
        """End a batch that was not processed, or let its requests go in smaller ones."""
        model, calls, rounds = self.note.model, len(self.note.lines), self.rounds
        is_only = rounds.open_batches(model) == [self]
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
            batch_id = self.note.batch_id and f" batch {self.note.batch_id}"
            self.error = kind(
                f"{model}: its batch mode refuses{batch_id}: {exc}. Every reply so far is saved: "
                "correct that, or leave --batch out, and run the same command to go on"
            )
        elif calls > 1 or not is_only:
            if model not in rounds.max_calls:
                rounds.say(f"{model}: {calls} calls go in smaller batches: {exc}")
            rounds.max_calls[model] = max(1, calls // 2) if is_only else calls
            # It counts as open, so that no other one is submitted meanwhile.
            await asyncio.sleep(exc.delay_s or 1.0)
            return
        self.default = no_result(outcome, str(exc), charged=False)

    def _on_unknown_fate(self, exc: BatchFailed) -> None:
        """End a batch that cannot be read: its reservations stay."""
        note = self.note
        can_be_found = note.batch_id or self._service.takes_mark
        # Another account's key may be refused a batch that goes on.
        if can_be_found and (self.rounds.submits or exc.kind != "lost"):
            raise EndpointRefused(
                f"{note.model}: batch {note.batch_id or note.mark} is refused to this key ({exc}): "
                "set the key of the account that submitted it. If it is gone, the same command "
                "without --batch asks its calls anew"
            ) from exc
        self.default = no_result("batch_lost", str(exc))

    async def _retry_transient(
        self, ask: Callable[[], Awaitable[T]], patience_s: float = math.inf
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
                    self.rounds.say(f"{self.note.model}: {exc}; it is asked again until it answers")
                tries += 1
                await asyncio.sleep(max(exc.delay_s or 0.0, backoff_s(tries)))


@dataclass(slots=True, eq=False)
class BatchRequest:
    """An attempt that waits for the next round; ``batch`` will be the one that it goes into."""

    request: ChatRequest
    number: int
    reservation: Reservation
    batch: asyncio.Future[Batch]


def no_result(name: str, why: str, *, charged: bool = True) -> AttemptOutcome:
    """Return the outcome of a request without a result: a normal request follows."""
    return AttemptOutcome("retry", name, why, charged=charged)
