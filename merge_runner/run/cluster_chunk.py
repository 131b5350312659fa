"""Chunks of trials, as they go to the workers of a Dask cluster and as they come back."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any

from merge_runner.errors import MergeRunnerError, RecordingError, TrialSuspended
from merge_runner.llm.cache import CachedCall, ResponseCache
from merge_runner.llm.call import Meter
from merge_runner.llm.durable import Operation, Rows
from merge_runner.llm.ledger import Asked, Ledger
from merge_runner.records import Attempt, TrialRecord, TrialSpec, Usage
from merge_runner.run.guard import FirstDecisions
from merge_runner.run.options import Options
from merge_runner.run.plan import Plan
from merge_runner.run.replay import Replay

# The calls with an answer, and by key the attempts at those without one.
Recorded = tuple[Sequence[CachedCall], Sequence[tuple[str, tuple[Attempt, ...]]]]


@dataclass(frozen=True, slots=True)
class RunSetup:
    """A run and how it is played; ``urls`` are the coordinator's base URLs."""

    run: str
    plan: Plan
    options: Options
    earlier: Mapping[str, Usage | None]
    first: FirstDecisions
    urls: Mapping[str, str]


@dataclass(frozen=True, slots=True)
class Chunk:
    """Trials for one worker, what is recorded of their calls, and its ``share`` of the limits.

    Its attempts are reserved under its ``name`` until it ends. The options of ``setup`` have its
    share of the trials in flight and of the cap.
    """

    name: str
    setup: RunSetup
    specs: Sequence[TrialSpec]
    share: float
    recorded: Recorded
    overruns: Sequence[tuple[str, float]]


@dataclass(slots=True)
class Played:
    """Result of a chunk; ``spent`` and ``opened`` are rows of the worker's ledger."""

    ended: list[tuple[TrialSpec, TrialRecord | TrialSuspended]] = field(default_factory=list)
    recorded: Recorded = ((), ())
    spent: Rows = field(default_factory=list)
    opened: Rows = field(default_factory=list)
    meters: Mapping[str, Meter] = field(default_factory=dict)
    error: MergeRunnerError | None = None


@dataclass(eq=False)
class Assignment:
    """A chunk on a worker, its events, and the money of its attempts.

    An event is a kind, an attempt's number, USD and an Asked; after the last one comes None.
    ``usd`` is by attempt its worst case, or its cost where that is known. The rows ``booked`` are
    counted as spent already.
    """

    address: str
    chunk: Chunk
    events: asyncio.Queue[tuple[Any, ...] | None] = field(default_factory=asyncio.Queue)
    usd: dict[int, float] = field(default_factory=dict)
    booked: Rows = field(default_factory=list)

    @property
    def unused_usd(self) -> float:
        """The rest of its share of the cap."""
        return max(0.0, (self.chunk.setup.options.max_cost_usd or 0.0) - sum(self.usd.values()))

    async def book(self, ledger: Ledger, cap_usd: float | None) -> dict[int, bool] | None:
        """Reserve the attempts and book the costs of the next events, in their order.

        Returns by attempt to reserve whether there is money for it; None after the last event.
        """
        events = [await self.events.get()]
        while not self.events.empty():
            events.append(self.events.get_nowait())
        messages = [event for event in events if event is not None]
        operations = list[Operation]()
        for kind, number, usd, asked in messages:
            attempt = self.chunk.name, number, usd
            if kind == "reserve":
                operations.append(partial(ledger.reserve, *attempt, cap_usd, Asked(*asked)))
            else:
                operations.append(partial(ledger.pay, *attempt, Asked(*asked).driver))
        results = await asyncio.gather(*map(ledger.store.write, operations))
        answers = dict[int, bool]()
        for (kind, number, usd, _), result in zip(messages, results, strict=True):
            if kind == "reserve":
                answers[number] = result
            else:
                self.booked.append(result)
            if result:
                self.usd[number] = usd
        return answers if len(messages) == len(events) else None


async def recorded_calls(plan: Plan, cache: ResponseCache, specs: Sequence[TrialSpec]) -> Recorded:
    """Return what the cache holds of the calls of trials, up to the first that is missing."""
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
