"""Plays a sweep on a Dask cluster whose workers share nothing.

A chunk of trials has a share of the rate limits and of the cap. Its worker plays it with the
ordinary runner and a reply folder of its own. The coordinator keeps its records and replies in one
transaction before it counts the chunk as done, and gives the chunk of a lost worker to another. It
fetches each attempt and each cost from the worker, and reserves the attempt's worst case durably
before it is sent, so that a lost attempt counts with its worst case.
"""

from __future__ import annotations

import asyncio
import contextlib
import math
import pickle
import secrets
from collections import Counter, deque
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import TYPE_CHECKING

from merge_runner.errors import MergeRunnerError, RecordingError, SweepStopped, TrialSuspended
from merge_runner.llm.attempts import Meter
from merge_runner.llm.cache import ResponseCache
from merge_runner.llm.call import Wait
from merge_runner.llm.durable import Operation, Rows
from merge_runner.llm.ledger import Cap, Ledger
from merge_runner.llm.store import CachedCall
from merge_runner.records import Attempt
from merge_runner.run.cluster_worker import (
    Chunk,
    MoneyEvent,
    Played,
    RunSetup,
    StoredCalls,
    begin_chunk,
    fingerprint,
    forget,
    go_on,
    stop,
)
from merge_runner.run.estimate import most_shares
from merge_runner.run.guard import FirstDecisions
from merge_runner.run.plan import Plan
from merge_runner.run.replay import Replay
from merge_runner.run.trials import Capacity, Ended
from merge_runner.trial_records import TrialRecord, TrialSpec

if TYPE_CHECKING:
    from distributed import Client

COUNT_WORKERS_EVERY_S = 1.0  # they may come and go
# Trials of a chunk for each trial in flight. A worker that dies loses its chunk, and the longest
# trial of a chunk delays the next one.
TRIALS_PER_SLOT = 4
MOST_LOSSES = 3


@dataclass(eq=False)
class Assignment:
    """A chunk on a worker, and the money of its attempts.

    ``usd`` has, by attempt, the worst case, or the cost if that is known. The rows ``booked`` are
    counted as spent already. ``unbooked`` is the error that ended the booking.
    """

    address: str
    chunk: Chunk
    usd: dict[int, float] = field(default_factory=dict)
    booked: Rows = field(default_factory=list)
    unbooked: MergeRunnerError | None = None

    @property
    def unused_usd(self) -> float:
        """The rest of the chunk's share of the cap."""
        cap = self.chunk.cap
        return max(0.0, cap.usd - sum(self.usd.values())) if cap is not None else 0.0

    async def play(self, client: Client, ledger: Ledger) -> Played | Exception:
        """Let the worker play the chunk and book its attempts; return why the worker is lost."""
        run, name, answers = self.chunk.setup.run, self.chunk.name, dict[int, bool]()
        # Not as a task of Dask, which would play a lost one again before its loss is booked.
        ask = partial(client.run, workers=[self.address], on_error="return")
        begun = await ask(begin_chunk, fingerprint(), pickle.dumps(self.chunk))
        played: Played | Exception | None = begun[self.address]
        while played is None:
            progress = (await ask(go_on, run, name, answers))[self.address]
            if isinstance(progress, Exception):
                return progress
            events, played = progress
            if self.unbooked is None:
                try:
                    answers = await self._book(events, ledger)
                except MergeRunnerError as exc:
                    # No attempt gets an answer any more; paid replies are kept.
                    self.unbooked, answers = exc, {}
                    await ask(stop, run)
        return played

    async def _book(self, events: Sequence[MoneyEvent], ledger: Ledger) -> dict[int, bool]:
        """Reserve the attempts and book the costs of events, in their order.

        Returns, for each attempt to reserve, whether it is reserved.
        """
        operations = list[Operation]()
        for event in events:
            attempt, label = (self.chunk.name, event.number, event.usd), event.label
            if event.is_cost:
                operations.append(partial(ledger.pay, *attempt, label.driver))
            else:
                operations.append(partial(ledger.reserve, *attempt, label))
        results = await asyncio.gather(*map(ledger.store.write, operations))
        answers = {}
        for event, result in zip(events, results, strict=True):
            if event.is_cost:
                self.booked.append(result)
            else:
                answers[event.number] = result
            if result:
                self.usd[event.number] = event.usd
        return answers


class ClusterRunner:
    """Player of trials on the workers of a cluster, each of which gets one chunk at a time."""

    waits: Sequence[Wait] = ()
    waiting_for_money = 0

    def __init__(
        self, client: Client, setup: RunSetup, cache: ResponseCache, ledger: Ledger
    ) -> None:
        self.meters = {name: Meter() for name in setup.plan.entries}
        self._workers = 0
        self._client = client
        self._setup = setup
        self._most_shares = most_shares(setup.plan, setup.options)
        self._cache = cache
        self._ledger = ledger
        self._groups: deque[list[TrialSpec]] = deque()
        self._assigned: dict[asyncio.Task[Played | Exception], Assignment] = {}
        self._losses = Counter[int]()  # by the order of a chunk's first trial
        self._one_by_one = False

    @property
    def first(self) -> FirstDecisions:
        """The first decisions of each model, over all workers."""
        return self._setup.first

    @property
    def running_trials(self) -> int:
        """The number of trials that workers have been given."""
        return sum(len(assignment.chunk.specs) for assignment in self._assigned.values())

    @property
    def place(self) -> str:
        """Text of the workers that trials are on."""
        return f" on {self._workers} workers"

    @property
    def unsaved(self) -> str:
        """Text of what an interrupted run saves before it ends."""
        return f"the replies of {len(self._assigned)} tasks"

    async def play(self, specs: Iterable[TrialSpec], ended: Ended, capacity: Capacity) -> None:
        """Play trials in order; an error raised by ``ended`` or at a worker ends the run."""
        self._ended = ended
        groups: dict[tuple[str, int], list[TrialSpec]] = {}
        for spec in specs:  # trials that may ask the same go together, so that one worker asks
            groups.setdefault((spec.condition, spec.repetition), []).append(spec)
        self._groups.extend(groups.values())
        try:
            while self._groups or self._assigned:
                addresses = list(await self._client.nthreads())
                self._workers = len(addresses)
                busy = {assignment.address for assignment in self._assigned.values()}
                for address in addresses:
                    if self._groups and address not in busy:
                        await capacity()
                        await self._give(address)
                await self._collect()
        except OSError as exc:
            raise SweepStopped(
                "the Dask scheduler is gone, and with it the tasks that were under way; run the "
                "same command again to go on"
            ) from exc

    async def drain(self) -> None:
        """Stop the workers, and keep the results of their chunks."""
        addresses = [assignment.address for assignment in self._assigned.values()]
        with contextlib.suppress(OSError):
            await self._client.run(stop, self._setup.run, workers=addresses, on_error="ignore")
        while self._assigned:
            with contextlib.suppress(MergeRunnerError, OSError):  # the first one has ended the run
                await self._collect()
        with contextlib.suppress(OSError):
            await self._client.run(forget, self._setup.run, on_error="ignore")

    async def _give(self, address: str) -> None:
        """Give a chunk to a worker, unless the chunks under way hold all shares."""
        setup, options = self._setup, self._setup.options
        slots = 1 if self._one_by_one else min(self._workers, self._most_shares)
        shares = sum(assignment.chunk.share for assignment in self._assigned.values())
        if shares + 1 / slots > 1.001:
            return
        in_flight, idle = options.in_flight // slots, max(1, slots - len(self._assigned))
        size = min(TRIALS_PER_SLOT * in_flight, math.ceil(sum(map(len, self._groups)) / idle))
        specs = self._groups.popleft()
        while self._groups and len(specs) + len(self._groups[0]) <= size:
            specs = specs + self._groups.popleft()
        calls = await recorded_calls(setup.plan, self._cache, specs)
        cap, spending = self._ledger.cap, self._ledger.read()
        if cap is not None:
            kept_usd = sum(assignment.unused_usd for assignment in self._assigned.values())
            share_usd = max(0.0, self._ledger.left_usd - kept_usd) / idle
            cap = Cap(share_usd, f"a task's share of {cap.source}")
        plan = setup.plan.model_copy(update={"parts": setup.plan.parts.without_code()})
        chunk = Chunk(
            name=f"task {secrets.token_hex(8)}",
            setup=replace(setup, plan=plan, options=replace(options, in_flight=in_flight)),
            cap=cap,
            specs=specs,
            share=1 / slots,
            calls=calls,
            overruns=[*spending.overruns.items()],
        )
        assignment = Assignment(address, chunk)
        task = asyncio.create_task(assignment.play(self._client, self._ledger))
        self._assigned[task] = assignment

    async def _collect(self) -> None:
        """Wait briefly for chunks, and keep the results of those that have ended."""
        if not self._assigned:
            await asyncio.sleep(COUNT_WORKERS_EVERY_S)
            return
        works = [*self._assigned]
        await asyncio.wait(
            works, timeout=COUNT_WORKERS_EVERY_S, return_when=asyncio.FIRST_COMPLETED
        )
        for work in filter(asyncio.Task.done, works):
            assignment = self._assigned.pop(work)
            played = work.result()
            if isinstance(played, Played):
                self._keep(assignment, played)
            else:
                self._lose(assignment, played)
            if assignment.unbooked is not None:
                raise assignment.unbooked

    def _keep(self, assignment: Assignment, played: Played) -> None:
        """Keep the results and the costs of a chunk; costs already ``booked`` count once."""
        chunk, plan = assignment.chunk, self._setup.plan
        booked = [(driver, -usd, -over_usd, 0.0) for driver, usd, over_usd in assignment.booked]
        spent = [*booked, *played.spent]
        share = partial(self._ledger.share, chunk.name, spent, played.opened)
        self._cache.put_now(*played.calls, [] if plan.is_free else [share])
        for model, meter in played.meters.items():
            self.meters[model].add(meter)
        arms = plan.by_label()
        for spec, record in played.ended:
            if isinstance(record, TrialSuspended) and chunk.share < 1:
                # All the money that is left goes to one chunk at a time.
                self._one_by_one = True
                self._groups.appendleft([spec])
                continue
            self._ended(spec, record)
            names = arms[spec.arm].full_names
            for row in record.decisions if isinstance(record, TrialRecord) else ():
                if names[row.side] in plan.entries:
                    self.first.count_decision(names[row.side], row.decision)
        if played.exit_code:
            stopped = SweepStopped(
                f"{played.error} (reported by the Dask worker {assignment.address})"
            )
            stopped.exit_code = played.exit_code
            raise stopped

    def _lose(self, assignment: Assignment, error: Exception) -> None:
        """Put the trials of a lost chunk back; its attempts of unknown cost stay reserved."""
        specs = [*assignment.chunk.specs]
        self._losses[specs[0].order] += 1
        if self._losses[specs[0].order] == MOST_LOSSES:
            raise SweepStopped(
                f"a task was begun on {MOST_LOSSES} Dask workers, and all died ({error!r}). Look "
                "whether they have the same merge-runner, at their memory and their logs; run the "
                "same command again to go on"
            )
        self._groups.appendleft(specs)
        lost = f"the worker {assignment.address} is lost: its {len(specs)} trials go to others"
        next(iter(self.meters.values())).notes.append(lost)


async def recorded_calls(
    plan: Plan, cache: ResponseCache, specs: Sequence[TrialSpec]
) -> StoredCalls:
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
