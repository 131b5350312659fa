"""Plays a sweep on a Dask cluster whose workers share nothing.

A task is a chunk of trials with a share of the rate limits and of the cap. Its worker plays it with
the ordinary runner and a reply folder of its own, and returns records and replies. The coordinator
keeps them in one transaction before it counts the task as done. A worker that dies loses its
unfinished task, which is given out again.

Before an attempt is sent, the coordinator reserves its worst case durably, under the name of the
task. What is lost with a worker or a coordinator so counts with what it may have cost, no more.
"""

from __future__ import annotations

import asyncio
import contextlib
import math
import pickle
import secrets
from collections import Counter, deque
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import TYPE_CHECKING, Any

from merge_runner.config import base_urls
from merge_runner.errors import (
    MergeRunnerError,
    RecordingError,
    SweepStopped,
    TrialSuspended,
)
from merge_runner.llm.cache import CachedCall, ResponseCache
from merge_runner.llm.call import Meter, Wait
from merge_runner.llm.durable import Rows
from merge_runner.llm.ledger import Ledger
from merge_runner.records import Attempt, TrialRecord, TrialSpec, Usage
from merge_runner.run.cluster_worker import (
    Played,
    Recorded,
    Task,
    Told,
    exchange,
    fingerprint,
    play_task,
    stop,
)
from merge_runner.run.guard import FirstDecisions
from merge_runner.run.plan import Options, Plan
from merge_runner.run.replay import Replay
from merge_runner.run.trials import Ended, Room

if TYPE_CHECKING:
    from distributed import Client

# Workers may come and go: how often they are counted.
LOOK_EVERY_S = 1.0
# A worker that dies loses so many times its trials in flight, and the longest trial of a task
# holds the others up.
TRIALS_PER_SEAT = 4
MOST_LOSSES = 3


@dataclass(eq=False)
class DaskTasks:
    """Plays trials on the workers of a cluster, each of which gets one task at a time."""

    _client: Client
    _plan: Plan
    _options: Options
    _earlier: Mapping[str, Usage | None]
    _cache: ResponseCache
    _ledger: Ledger
    first: FirstDecisions
    waits: Sequence[Wait] = ()
    held: int = 0
    workers: int = 0
    _run: str = field(default_factory=secrets.token_hex)
    _groups: deque[list[TrialSpec]] = field(default_factory=deque)
    _given: dict[str, tuple[Task, asyncio.Future[Any]]] = field(default_factory=dict)
    # By the name of a task under way: what each of its attempts may have cost, or has.
    _begun: dict[str, dict[int, float]] = field(default_factory=dict)
    # What of that is counted as spent already, as rows for ``settle_share``.
    _paid: dict[str, Rows] = field(default_factory=dict)
    _losses: Counter[int] = field(default_factory=Counter)
    _one_by_one: bool = False

    def __post_init__(self) -> None:
        self.meters = {name: Meter() for name in self._plan.entries}
        self._sent = self._plan.model_copy(update={"parts": self._plan.parts.without_code()})

    @property
    def running(self) -> int:
        """How many trials are given out."""
        return sum(len(task.specs) for task, _ in self._given.values())

    @property
    def unsaved(self) -> str:
        """What Ctrl-C waits for, in words."""
        return f"the replies of {len(self._given)} tasks"

    async def play(self, specs: Iterable[TrialSpec], ended: Ended, room: Room) -> None:
        """Play trials in order; an error raised by ``ended`` or at a worker ends the run."""
        self._ended = ended
        groups: dict[tuple[str, int], list[TrialSpec]] = {}
        for spec in specs:  # trials that may ask the same go together, so that one worker asks
            groups.setdefault((spec.condition, spec.repetition), []).append(spec)
        self._groups.extend(groups.values())
        try:
            while self._groups or self._given:
                addresses = list(await self._client.nthreads())
                self.workers = len(addresses)
                for address in addresses:
                    if self._groups and address not in self._given:
                        await room()
                        await self._give(address)
                await self._collect()
        except OSError as exc:
            raise SweepStopped(
                "the Dask scheduler is gone, and with it the tasks that were under way; run the "
                "same command again to go on"
            ) from exc

    async def drain(self) -> None:
        """Stop the workers, and keep what their tasks have brought."""
        with contextlib.suppress(OSError):
            await self._client.run(stop, self._run, workers=[*self._given], on_error="ignore")
        while self._given:
            with contextlib.suppress(MergeRunnerError, OSError):  # the first one is told already
                await self._collect()

    async def _give(self, address: str) -> None:
        """Give a task to a worker, unless those under way still hold all shares."""
        slots = 1 if self._one_by_one else min(self.workers, self._options.in_flight)
        held = sum(task.share for task, _ in self._given.values())
        if held + 1 / slots > 1.001:
            return
        in_flight, idle = self._options.in_flight // slots, max(1, slots - len(self._given))
        left = sum(map(len, self._groups))
        size = min(TRIALS_PER_SEAT * in_flight, math.ceil(left / idle))
        specs = self._groups.popleft()
        while self._groups and len(specs) + len(self._groups[0]) <= size:
            specs = specs + self._groups.popleft()
        recorded = await self._recorded(specs)
        name = f"task {secrets.token_hex(8)}"
        cap_usd = self._options.max_cost_usd
        if cap_usd is not None:
            self._ledger.read()
            kept_usd = sum(
                max(0.0, (task.options.max_cost_usd or 0.0) - sum(self._begun[task.name].values()))
                for task, _ in self._given.values()
            )
            cap_usd = max(0.0, cap_usd - self._ledger.committed_usd - kept_usd) / idle
        task = Task(
            run=self._run,
            name=name,
            specs=specs,
            plan=self._sent,
            options=replace(self._options, in_flight=in_flight, max_cost_usd=cap_usd),
            urls=base_urls(self._plan.entries),
            earlier=self._earlier,
            share=1 / slots,
            first=self.first,
            recorded=recorded,
            overruns=[*self._ledger.read().overruns.items()],
        )
        self._begun[name], self._paid[name] = {}, []
        self._given[address] = task, asyncio.create_task(self._work(address, task))

    async def _work(self, address: str, task: Task) -> Any:  # noqa: ANN401 # or what went wrong
        """Let a worker play a task, and reserve its attempts meanwhile; return what it returns."""
        attending = asyncio.create_task(self._attend(address, task))

        async def play() -> Any:  # noqa: ANN401
            # Out of Dask's scheduling, which would retry it: the share of the cap is spent once.
            arguments = (play_task, fingerprint(), pickle.dumps(task), task.name)
            played = await self._client.run(*arguments, workers=[address], on_error="return")
            if not isinstance(played[address], Played):
                attending.cancel()  # a task that never began would never say that it has ended
            return played[address]

        async def attend() -> None:
            with contextlib.suppress(asyncio.CancelledError):
                await attending

        played, _ = await asyncio.gather(play(), attend())
        return played

    async def _attend(self, address: str, task: Task) -> None:
        """Reserve each attempt of a task before it is sent, and book what it costs, until it ends.

        What is spent stays so, whatever becomes of the worker.
        """
        write, begun, ledger = self._cache.write, self._begun[task.name], self._ledger
        cap_usd, answers = self._options.max_cost_usd, dict[int, bool]()
        drivers = dict[int, str]()
        while True:
            told = (
                await self._client.run(
                    exchange, task.name, answers, workers=[address], on_error="return"
                )
            )[address]
            if not isinstance(told, Told):
                return  # lost, as the task is
            drivers.update({number: asked.driver for number, (_, asked) in told.asking.items()})
            costs = [
                partial(ledger.pay, task.name, number, usd, drivers[number])
                for number, usd in told.costs.items()
            ]
            worst = [
                partial(ledger.reserve, task.name, number, usd, cap_usd, asked)
                for number, (usd, asked) in told.asking.items()
            ]
            self._paid[task.name] += await asyncio.gather(*map(write, costs))
            paid = await asyncio.gather(*map(write, worst))
            answers = dict(zip(told.asking, paid, strict=True))
            begun.update({n: told.asking[n][0] for n, is_paid in answers.items() if is_paid})
            begun.update(told.costs)
            if told.done:
                return

    async def _recorded(self, specs: Sequence[TrialSpec]) -> Recorded:
        """What the cache holds of the calls of these trials, up to the first that is missing."""
        replay = Replay(self._plan, self._cache)
        answered: dict[str, CachedCall] = {}
        unanswered: dict[str, tuple[Attempt, ...]] = {}
        for spec in specs:
            await asyncio.sleep(0)
            record = replay.play_one(spec)
            replies = (row.decision.reply for row in record.decisions)
            answered |= {r.request.key: CachedCall(r.request, r.attempts) for r in replies if r}
            for call in record.failed_calls:
                with contextlib.suppress(RecordingError):  # a damaged one is asked again
                    if attempts := self._cache.look_up(call.request.key)[1]:
                        unanswered[call.request.key] = attempts
        return [*answered.values()], [*unanswered.items()]

    async def _collect(self) -> None:
        """Wait a while for tasks, and keep what those that have ended return."""
        if not self._given:
            await asyncio.sleep(LOOK_EVERY_S)
            return
        works = [work for _, work in self._given.values()]
        await asyncio.wait(works, timeout=LOOK_EVERY_S, return_when=asyncio.FIRST_COMPLETED)
        for address in [address for address, (_, work) in self._given.items() if work.done()]:
            task, work = self._given.pop(address)
            played = work.result()
            del self._begun[task.name]
            paid = self._paid.pop(task.name)
            if not isinstance(played, Played):
                self._lose(task, address, played)
                continue
            self._keep(task, played, paid)
            if (error := played.error) is not None:
                raise type(error)(f"{error} (told by the Dask worker {address})")

    def _keep(self, task: Task, played: Played, paid: Rows) -> None:
        """Keep what a task has brought and what it cost; what is ``paid`` is counted once."""
        counted = [(driver, -usd, -over_usd, 0.0) for driver, usd, over_usd in paid]
        share = partial(self._ledger.share, task.name, [*counted, *played.spent], played.opened)
        self._cache.put_now(*played.recorded, [] if self._plan.is_free else [share])
        for model, meter in played.meters.items():
            self.meters[model].add(meter)
        arms = self._plan.by_label()
        for spec, record in played.ended:
            if isinstance(record, TrialSuspended) and task.share < 1:
                # All the money that is left goes to one task at a time.
                self._one_by_one = True
                self._groups.appendleft([spec])
                continue
            self._ended(spec, record)
            asked = arms[spec.arm].asked
            for row in record.decisions if isinstance(record, TrialRecord) else ():
                if asked[row.side] in self._plan.entries:
                    self.first.count(asked[row.side], row.decision)

    def _lose(self, task: Task, address: str, error: Exception) -> None:
        """Give the trials of a lost task out again; its attempts without a cost stay reserved."""
        self._losses[task.specs[0].order] += 1
        if self._losses[task.specs[0].order] == MOST_LOSSES:
            raise SweepStopped(
                f"a task was begun on {MOST_LOSSES} Dask workers, and all died ({error!r}). Look "
                "whether they have the same merge-runner, at their memory and their logs; run the "
                "same command again to go on"
            )
        self._groups.appendleft([*task.specs])
        lost = f"the worker {address} is lost: its {len(task.specs)} trials go to others"
        next(iter(self.meters.values())).notes.append(lost)
