"""Rounds: the pending questions of all trials are submitted together as batches.

A round is closed when no trial can go on before a reply comes. So all trials advance by one
decision at a time, and a sweep takes as many rounds as its longest trial has decisions. A call that
waits in an open batch is not repeated: it joins those that wait there. One process at a time asks
a model in a cache, so it knows all notes of its models once it has read them.
"""

from __future__ import annotations

import asyncio
import contextlib
import itertools
import secrets
from collections import defaultdict
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import partial

from pydantic import ValidationError

from merge_runner.errors import RecordingError
from merge_runner.llm.batch.lifecycle import PREFIX, Batch, BatchNote, BatchRequest, no_result
from merge_runner.llm.batch.service import BatchService
from merge_runner.llm.budget import Reservation
from merge_runner.llm.cache import ResponseCache
from merge_runner.llm.call import Call, Wait
from merge_runner.llm.http_outcome import AttemptOutcome
from merge_runner.llm.sender import Sent

# Poll interval of the idle check: only idleness closes a round, never the time.
IDLE_POLL_S = 0.05
# Turns of the event loop in each check, so that runnable tasks can submit first.
IDLE_TURNS = 5
# Below the limit of every provider, so that a lost or late batch concerns few calls.
MAX_CALLS = 5_000


class Rounds:
    """The rounds of a run; ``services`` are the batch modes of its models, by registered name.

    A run that does not ``submit`` only takes what earlier runs have submitted. ``batches`` are all
    that calls of its ``models`` wait in, by mark, the oldest first; ``pending`` has, by key of a
    call, the batch in which its last attempt waits since an earlier run. ``max_calls`` is set for a
    model after its provider has rejected a batch as too large; such a model has one open batch at a
    time.
    """

    def __init__(
        self,
        cache: ResponseCache,
        models: Collection[str],
        *,
        submits: bool,
        say: Callable[[str], None],
    ) -> None:
        self.cache = cache
        self.submits = submits
        self.say = say
        self.services: dict[str, BatchService] = {}
        self.max_calls: dict[str, int] = {}
        self._forming: defaultdict[str, list[BatchRequest]] = defaultdict(list)
        notes = []
        for name in cache.names(PREFIX):
            with contextlib.suppress(RecordingError, ValidationError):  # a damaged note is ignored
                notes.append(BatchNote.model_validate_json(cache.read(name) or ""))
        notes.sort(key=lambda note: (note.number, note.submitted_at))
        self._numbers = itertools.count(max((note.number for note in notes), default=0) + 1)
        noted = [Batch(self, note) for note in notes if note.model in models]
        last = {key: batch for batch in noted for key in batch.note.lines}
        self.pending = {key: b for key, b in last.items() if not self._has_ended(key, b)}
        is_open = {*self.pending.values()}
        self.batches = {batch.note.mark: batch for batch in noted if batch in is_open}
        ended = [PREFIX + batch.note.mark for batch in noted if batch not in is_open]
        cache.run_now([partial(cache.remove, name) for name in ended])

    async def outcome_of(
        self, call: Call, number: int, reservation: Reservation, model: str
    ) -> tuple[AttemptOutcome, Batch]:
        """Return the outcome of an attempt in the batch where it waits, or in the next round.

        Raises TrialSuspended where its money cannot be reserved.
        """
        request, batch = call.request, call.pending_batch
        while True:
            if batch is None:
                next_batch: asyncio.Future[Batch] = asyncio.get_running_loop().create_future()
                waiting = BatchRequest(request, number, reservation, next_batch)
                self._forming[model].append(waiting)
                batch = await next_batch
            await asyncio.shield(batch.work or batch.start())
            if without_money := batch.suspended.get(request.key):
                raise without_money
            outcome = batch.results.pop(request.key, batch.default)
            if outcome is None and not self.submits:
                outcome = no_result("not_created", "the run ended before", charged=False)
            if outcome is not None:
                self.pending.pop(request.key, None)
                return outcome, batch
            batch = None

    async def watch(self, is_idle: Callable[[], bool]) -> None:
        """Close each round as soon as all trials wait, by ``is_idle``."""
        while True:
            await asyncio.sleep(IDLE_POLL_S)
            for _ in range(IDLE_TURNS):
                await asyncio.sleep(0)
                if not (any(self._forming.values()) and is_idle()):
                    break
            else:
                self._close_round()

    def status_lines(self) -> list[str]:
        """Return a line for each open batch."""
        return [
            f"{len(note.lines)} calls of {note.model} wait in batch {note.batch_id or 'to be'} "
            f"since {note.submitted_at:%H:%M:%S} UTC"
            for note in (batch.note for batch in self.open_batches())
        ]

    def open_batches(self, model: str | None = None) -> list[Batch]:
        """Return the batches that have not ended: they take room at their provider."""
        return [
            batch
            for batch in self.batches.values()
            if (work := batch.work) and model in (None, batch.note.model)
            # A batch whose task was cancelled goes on at its provider.
            if work.cancelled() or not work.done()
        ]

    async def close(self) -> None:
        """Cancel all waiting; the ids of batches that are being created are noted first."""
        work = [batch.work for batch in self.batches.values() if batch.work]
        for task in work:
            task.cancel()
        await asyncio.gather(*work, return_exceptions=True)

    def _has_ended(self, key: str, batch: Batch) -> bool:
        with contextlib.suppress(RecordingError):  # damaged: its attempts are unknown
            entry, attempts = self.cache.look_up(key)
            outcomes = {attempt.number: attempt.outcome for attempt in attempts}
            return entry is not None or outcomes.get(batch.note.lines[key], "unknown") != "unknown"
        return False

    def _close_round(self) -> None:
        """Submit the gathered requests in batches, each of one model."""
        for model, gathered in self._forming.items():
            requests = [r for r in gathered if not r.batch.done()]  # their calls are not given up
            most, now = self.max_calls.get(model, MAX_CALLS), len(requests)
            if model in self.max_calls:  # one batch at a time; the others wait for the next round
                now = 0 if self.open_batches(model) else most
            self._forming[model] = requests[now:]
            for at in range(0, len(requests[:now]), most):
                self._submit(model, requests[at : at + most])

    def _submit(self, model: str, requests: Sequence[BatchRequest]) -> None:
        note = BatchNote(
            mark=secrets.token_hex(16),
            model=model,
            number=next(self._numbers),
            submitted_at=datetime.now(UTC),
            lines={attempt.request.key: attempt.number for attempt in requests},
        )
        batch = self.batches[note.mark] = Batch(self, note)
        batch.start(requests)
        for attempt in requests:
            attempt.batch.set_result(batch)


@dataclass(slots=True)
class BatchSender:
    """Sender of attempts of a model, by its name in the registry, in the rounds of a run."""

    rounds: Rounds
    model: str
    price_factor: float

    def takes(self, call: Call) -> bool:
        """Return whether the next attempt of a call goes into a batch, or waits in one already."""
        is_new = self.rounds.submits and not call.bypass_batch
        return is_new or call.pending_batch is not None

    async def send(self, call: Call, number: int, reservation: Reservation) -> Sent:
        """Wait for the outcome of attempt ``number`` in its batch or in the next round."""
        call.wait = Wait(f"for batches of {self.model}", blocked=True, charged=True)
        outcome, batch = await self.rounds.outcome_of(call, number, reservation, self.model)
        call.wait, call.pending_batch, call.bypass_batch = None, None, True
        note = batch.note
        return Sent(outcome, note.submitted_at, batch_id=note.batch_id or None, error=batch.error)
