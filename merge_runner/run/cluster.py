"""Plays a sweep on a Dask cluster whose workers share nothing.

A worker plays a chunk of trials with the ordinary runner, a reply folder of its own, and a share of
the rate limits and of the cap. Each write of its folder is made at the coordinator, too: an attempt
is reserved there before it is sent, and a reply is kept there before its trial goes on. So the
chunk of a lost worker goes to another, and only its attempts in flight are made again.
"""

from __future__ import annotations

import asyncio
import contextlib
import math
import pickle
from collections import Counter, deque
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

from merge_runner.errors import MergeRunnerError, RecordingError, SweepStopped, TrialSuspended
from merge_runner.llm.attempts import Meter
from merge_runner.llm.cache import ResponseCache
from merge_runner.llm.call import Wait
from merge_runner.llm.ledger import Cap, Ledger
from merge_runner.llm.store import Attempts, CachedCall
from merge_runner.run.cluster_worker import (
    Chunk,
    Played,
    begin_chunk,
    fingerprint,
    forget,
    go_on,
    stop,
    unpickled,
)
from merge_runner.run.estimate import most_shares
from merge_runner.run.guard import FirstDecisions
from merge_runner.run.parts import Parts
from merge_runner.run.plan import Plan
from merge_runner.run.replay import Replay
from merge_runner.run.trials import Capacity, Ended
from merge_runner.trial_records import TrialRecord, TrialSpec

if TYPE_CHECKING:
    from distributed import Client

COUNT_WORKERS_EVERY_S = 1.0  # they may come and go
# Trials of a chunk for each trial in flight. The longest trial of a chunk delays the next chunk.
TRIALS_PER_SLOT = 4
MOST_LOSSES = 3


@dataclass(eq=False)
class Assignment:
    """A chunk on a worker; ``left_usd`` is the rest of its share of the cap."""

    address: str
    chunk: Chunk
    left_usd: float


class ClusterRunner:
    """Player of trials on the workers of a cluster, each of which gets one chunk at a time."""

    waits: Sequence[Wait] = ()
    waiting_for_money = 0

    def __init__(
        self, client: Client, plan: Plan, whole: Chunk, cache: ResponseCache, ledger: Ledger
    ) -> None:
        """Take the ``whole`` run as one chunk, of which parts are given to workers."""
        self.meters = {name: Meter() for name in plan.entries}
        self._workers = 0
        self._client = client
        self._plan = plan
        # Not everywhere can the code of its parts be imported: workers make them from its source.
        self._whole = replace(whole, plan=plan.model_copy(update={"parts": Parts()}))
        self._most_shares = most_shares(plan, whole.options)
        self._cache = cache
        self._ledger = ledger
        self._stores = {
            "cache": cache,
            "ledger of " + ledger.scope: ledger,
            "ledger of ": Ledger(cache, ""),
        }
        self._groups: deque[list[TrialSpec]] = deque()
        self._assigned: dict[asyncio.Task[Played | Exception], Assignment] = {}
        self._losses = Counter[int]()  # by the order of a chunk's first trial
        self._one_by_one = False

    @property
    def first(self) -> FirstDecisions:
        """The first decisions of each model, over all workers."""
        return self._whole.first

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
            await self._client.run(stop, self._whole.run, workers=addresses, on_error="ignore")
        while self._assigned:
            with contextlib.suppress(MergeRunnerError, OSError):  # the first one has ended the run
                await self._collect()
        with contextlib.suppress(OSError):
            await self._client.run(forget, self._whole.run, on_error="ignore")

    async def _give(self, address: str) -> None:
        """Give a chunk to a worker, unless the chunks under way hold all shares."""
        options = self._whole.options
        slots = 1 if self._one_by_one else min(self._workers, self._most_shares)
        shares = sum(assignment.chunk.share for assignment in self._assigned.values())
        if shares + 1 / slots > 1.001:
            return
        in_flight, idle = options.in_flight // slots, max(1, slots - len(self._assigned))
        size = min(TRIALS_PER_SLOT * in_flight, math.ceil(sum(map(len, self._groups)) / idle))
        specs = self._groups.popleft()
        while self._groups and len(specs) + len(self._groups[0]) <= size:
            specs = specs + self._groups.popleft()
        recorded = await recorded_calls(self._plan, self._cache, specs)
        cap, spending, share_usd = self._ledger.cap, self._ledger.read(), math.inf
        if cap is not None:
            kept_usd = sum(assignment.left_usd for assignment in self._assigned.values())
            share_usd = max(0.0, self._ledger.left_usd - kept_usd) / idle
            cap = Cap(share_usd, f"a task's share of {cap.source}")
        chunk = replace(
            self._whole, options=replace(options, in_flight=in_flight), share=1 / slots, cap=cap,
            specs=specs, recorded=recorded, overruns=spending.overruns,
        )  # fmt: skip
        assignment = Assignment(address, chunk, share_usd)
        self._assigned[asyncio.create_task(self._played(assignment))] = assignment

    async def _played(self, assignment: Assignment) -> Played | Exception:
        """Let a worker play its chunk; return why the worker is lost."""

        async def ask(function: Callable[..., object], *arguments: object) -> Any:  # noqa: ANN401
            # Not as a task of Dask, which would play a lost one again as it was.
            run = self._client.run(function, *arguments, workers=[address], on_error="return")
            return (await run)[address]

        address = assignment.address
        heard = await ask(begin_chunk, fingerprint(), pickle.dumps(assignment.chunk))
        while isinstance(heard, tuple):
            pickled, assignment.left_usd = heard
            operations = [unpickled(operation, self._stores) for operation in pickled]
            writing = map(self._cache.write, operations)
            results = await asyncio.gather(*writing, return_exceptions=True)
            heard = await ask(go_on, self._whole.run, results)
        played: Played | Exception = heard
        return played

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

    def _keep(self, assignment: Assignment, played: Played) -> None:
        plan = self._plan
        for model, meter in played.meters.items():
            self.meters[model].add(meter)
        arms = plan.by_label()
        for spec, record in played.ended:
            if isinstance(record, TrialSuspended) and assignment.chunk.share < 1:
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
        """Put the trials of a lost chunk back; its attempts in flight stay reserved."""
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
) -> tuple[list[CachedCall], list[tuple[str, Attempts]]]:
    """Return the recorded calls of trials, of each one up to its first missing call.

    They are the calls with an answer, and by key the attempts at those without one.
    """
    replay = Replay(plan, cache)
    answered: dict[str, CachedCall] = {}
    unanswered: dict[str, Attempts] = {}
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
