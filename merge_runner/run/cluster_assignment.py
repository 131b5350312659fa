"""A chunk of trials on a worker of a Dask cluster, as the coordinator sees it."""

from __future__ import annotations

import asyncio
import contextlib
import pickle
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import TYPE_CHECKING, Any

from merge_runner.errors import RecordingError
from merge_runner.llm.cache import ResponseCache
from merge_runner.llm.durable import Operation, Rows
from merge_runner.llm.ledger import CallLabel, Ledger
from merge_runner.llm.store import CachedCall
from merge_runner.records import Attempt
from merge_runner.run.cluster_worker import (
    Chunk,
    Recorded,
    answer,
    fingerprint,
    play_chunk,
    stop,
)
from merge_runner.run.plan import Plan
from merge_runner.run.replay import Replay
from merge_runner.trial_records import TrialSpec

if TYPE_CHECKING:
    from distributed import Client


@dataclass(eq=False)
class Assignment:
    """A chunk on a worker, its events, and the money of its attempts.

    An event is a kind, an attempt's number, USD and a CallLabel; after the last one comes None.
    ``usd`` is by attempt its worst case, or its cost where that is known; ``is_reserved`` has those
    that asked for a reservation. The rows ``booked`` are counted as spent already.
    """

    address: str
    chunk: Chunk
    events: asyncio.Queue[tuple[Any, ...] | None] = field(default_factory=asyncio.Queue)
    usd: dict[int, float] = field(default_factory=dict)
    is_reserved: dict[int, bool] = field(default_factory=dict)
    booked: Rows = field(default_factory=list)

    @property
    def unused_usd(self) -> float:
        """The rest of its share of the cap."""
        cap = self.chunk.cap
        return max(0.0, cap.usd - sum(self.usd.values())) if cap is not None else 0.0

    async def play(self, client: Client, ledger: Ledger) -> tuple[Any, BaseException | None]:
        """Let the worker play the chunk, and book its attempts meanwhile.

        Returns the worker's result, or why it is lost, and the error that ended the booking.
        """
        run, setup = partial(client.run, workers=[self.address]), self.chunk.setup

        async def play() -> Any:  # noqa: ANN401
            # Not as a task of Dask, which would play a lost one again before its loss is booked.
            chunk = pickle.dumps(self.chunk)
            try:
                results = await run(play_chunk, fingerprint(), chunk, on_error="return")
            finally:
                self.events.put_nowait(None)
            return results[self.address]

        async def book() -> None:
            while (answers := await self._book(ledger)) is not None:
                if answers:
                    await run(answer, setup.run, self.chunk.name, answers, on_error="ignore")

        playing, booking = asyncio.create_task(play()), asyncio.create_task(book())
        await asyncio.wait([playing, booking], return_when=asyncio.FIRST_EXCEPTION)
        if not playing.done():  # no attempt gets an answer any more; paid replies are kept
            with contextlib.suppress(OSError):  # the scheduler is gone, as the result will say
                await run(stop, setup.run, on_error="ignore")
        await asyncio.wait([playing, booking])
        unbooked = booking.exception()
        return playing.result(), unbooked

    async def _book(self, ledger: Ledger) -> dict[int, bool] | None:
        """Reserve the attempts and book the costs of the next events, in their order.

        Returns, for each attempt to reserve, whether it is reserved; None after the last event.
        """
        events = [await self.events.get()]
        while not self.events.empty():
            events.append(self.events.get_nowait())
        messages = [event for event in events if event is not None]
        # An attempt that has waited long asks again.
        new = {e[:2]: e for e in messages if e[0] == "cost" or e[1] not in self.is_reserved}
        operations = list[Operation]()
        for kind, number, usd, label in new.values():
            attempt = self.chunk.name, number, usd
            if kind == "reserve":
                operations.append(partial(ledger.reserve, *attempt, CallLabel(*label)))
            else:
                operations.append(partial(ledger.pay, *attempt, CallLabel(*label).driver))
        results = await asyncio.gather(*map(ledger.store.write, operations))
        for (kind, number, usd, _), result in zip(new.values(), results, strict=True):
            if kind == "reserve":
                self.is_reserved[number] = result
            else:
                self.booked.append(result)
            if result:
                self.usd[number] = usd
        if len(messages) < len(events):
            return None
        return {number: self.is_reserved[number] for kind, number, *_ in messages if kind != "cost"}


async def recorded_calls(plan: Plan, cache: ResponseCache, specs: Sequence[TrialSpec]) -> Recorded:
    """Return the recorded calls of trials, of each one up to its first missing call."""
    replay = Replay(plan, cache)
    answered: dict[str, CachedCall] = {}
    unanswered: dict[str, tuple[Attempt, ...]] = {}
    for spec in specs:
        await asyncio.sleep(0)
        record = replay.play_one(spec)
        replies = (row.decision.reply for row in record.decisions)
        answered |= {r.request.key: CachedCall(r.request, r.attempts) for r in replies if r}
        for call in record.failed_calls:
            with contextlib.suppress(RecordingError):  # a damaged one is asked again
                if attempts := cache.look_up(call.request.key)[1]:
                    unanswered[call.request.key] = attempts
    return [*answered.values()], [*unanswered.items()]
