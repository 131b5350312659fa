"""Plays a sweep on a Dask cluster whose workers share nothing.

A task is a chunk of trials with a share of the rate limits and of the cap. Its worker plays it with
the ordinary runner and a reply folder of its own, and returns records and replies. The coordinator
keeps them in one transaction before it counts the task as done. A worker that dies loses its
unfinished task, which is given out again; its share of the cap stays reserved.
"""

from __future__ import annotations

import asyncio
import contextlib
import hashlib
import itertools
import math
import secrets
import socket
import threading
from collections import Counter, deque
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import AsyncExitStack
from dataclasses import dataclass, field, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from distributed import Client, Future, Worker, get_worker
from distributed.scheduler import KilledWorker

import merge_runner
from merge_runner.errors import (
    ClusterFailed,
    MergeRunnerError,
    RecordingError,
    TrialSuspended,
    UsageError,
)
from merge_runner.llm.cache import CachedCall, ResponseCache
from merge_runner.llm.call import Wait
from merge_runner.llm.ledger import Asked, Ledger, Rows
from merge_runner.llm.limiter import WINDOW_S
from merge_runner.llm.meter import Meter
from merge_runner.records import Attempt, TrialRecord, TrialSpec
from merge_runner.registry import in_use, plugin_sources, use
from merge_runner.run.clients import EndpointPlan, live_clients, sealed_clients
from merge_runner.run.estimate import trial_costs
from merge_runner.run.first_decisions import FirstDecisions
from merge_runner.run.local_runner import Ended, LocalRunner, Room, no_wait
from merge_runner.run.plan import Options, Plan
from merge_runner.study.file import StudySource
from merge_runner.study.parts import catalogue_of

# Workers may come and go: how often they are counted.
LOOK_EVERY_S = 1.0
STOP_EVERY_S = 0.1
# A scheduler that hangs must not keep Ctrl-C from ending the run.
GOODBYE_S = 5.0
# A worker that dies loses so many times its trials in flight, and the longest trial of a task
# holds the others up.
TRIALS_PER_SEAT = 4
MOST_LOSSES = 3
SCHEDULER_GONE = (
    "the Dask scheduler is gone, and with it the tasks that were under way; run the same command "
    "again to go on"
)
_making_catalogue = threading.Lock()


@dataclass(frozen=True, slots=True)
class Task:
    """Trials for one worker process, and what is recorded of their calls.

    ``share`` is that of the rate limits; ``tokens`` of each model count as used already.
    ``machine`` is the coordinator's.
    """

    worker: str
    run: str
    machine: str
    specs: Sequence[TrialSpec]
    plan: Plan
    options: Options
    endpoints: EndpointPlan
    share: float
    tokens: Mapping[str, int]
    first: FirstDecisions
    recorded: Sequence[CachedCall]
    unanswered: Mapping[str, tuple[Attempt, ...]]
    overruns: Mapping[str, float]


@dataclass(slots=True)
class Played:
    """What a worker returns; ``tokens`` of each model were used within the last minute."""

    records: list[TrialRecord] = field(default_factory=list)
    suspended: list[tuple[TrialSpec, str]] = field(default_factory=list)
    replies: list[CachedCall] = field(default_factory=list)
    unanswered: dict[str, tuple[Attempt, ...]] = field(default_factory=dict)
    spent: Rows = field(default_factory=list)
    opened: Rows = field(default_factory=list)
    meters: dict[str, Meter] = field(default_factory=dict)
    tokens: dict[str, int] = field(default_factory=dict)
    error: MergeRunnerError | None = None


@dataclass(slots=True)
class _Given:
    """A task under way: ``usd`` is reserved under ``name``, None where nothing is paid."""

    task: Task
    address: str
    name: str
    usd: float | None
    future: Future
    given_at: float


# At a worker


def introduce(*, dask_worker: Worker) -> tuple[str, str, str]:
    """Return the id of a worker's process, the fingerprint of its program, and its machine."""
    # Dask's profiler samples all threads; Python 3.11 can deadlock there.
    dask_worker.periodic_callbacks["profile"].stop()
    return dask_worker.id, fingerprint(), socket.gethostname()


def fingerprint() -> str:
    """Return the version and a hash of all source and plug-ins."""
    code = hashlib.sha256()
    for source in (Path(merge_runner.__file__).parent, *plugin_sources()):
        for path in sorted(source.rglob("*.py")) if source.is_dir() else [source]:
            code.update(f"{source.name}/{path.relative_to(source)}\0".encode() + path.read_bytes())
    return f"{merge_runner.__version__} ({code.hexdigest()[:12]})"


def stop(run: str, *, dask_worker: Worker) -> None:
    """Let the calls of a run's tasks end, and return what there is."""
    dask_worker.extensions.setdefault(run, threading.Event()).set()


def play_task(task: Task) -> Played | None:
    """Play a task; None in another process than it was given to, as when Dask retries it."""
    worker = get_worker()
    if worker.id != task.worker:
        return None
    use_study(task.plan.study)
    return asyncio.run(_play(task, worker.extensions.setdefault(task.run, threading.Event())))


def use_study(study: StudySource) -> None:
    """Use a study's catalogue; the one that other threads play by stays where it is the same."""
    with _making_catalogue:
        if (in_use().text, in_use().plugins) != (study.text, study.plugins):
            use(catalogue_of(study.file, study.text, study.plugins))


async def _play(task: Task, stopping: threading.Event) -> Played:
    played = Played()

    def ended(spec: TrialSpec, record: TrialRecord | TrialSuspended) -> None:
        if isinstance(record, TrialSuspended):
            played.suspended.append((spec, str(record)))
        else:
            played.records.append(record)

    async with AsyncExitStack() as stack:
        folder = Path(stack.enter_context(TemporaryDirectory(prefix="merge-runner-")))
        cache = ResponseCache(folder)
        stack.callback(cache.close)
        ledger = Ledger(cache, task.plan.ledger)
        cache.put_now(task.recorded, task.unanswered.items())
        ledger.settle_share(
            "", [(driver, 0, 0, ratio) for driver, ratio in task.overruns.items()], []
        )
        try:
            runner = await _runner(task, cache, ledger, stack)
            played.meters = dict(runner.meters)
            work = asyncio.create_task(runner.play(task.specs, ended))
            watch = asyncio.create_task(_cancel(work, stopping))
            await asyncio.wait([work])
            watch.cancel()
            await runner.drain()
            if not work.cancelled():
                work.result()
        except MergeRunnerError as exc:
            played.error = exc
        known = {call.request.key for call in task.recorded}
        played.replies = [call for call in cache.entries() if call.request.key not in known]
        played.unanswered = cache.all_unanswered()
        played.spent, played.opened = ledger.rows()
        played.tokens = {name: meter.last_minute()[1] for name, meter in played.meters.items()}
    return played


async def _runner(
    task: Task, cache: ResponseCache, ledger: Ledger, stack: AsyncExitStack
) -> LocalRunner:
    urls = task.endpoints.urls
    if "//127.0.0.1:" in urls.get("EMULATOR_BASE_URL", "") and task.machine != socket.gethostname():
        raise UsageError(
            "the emulator listens on the coordinator's machine alone: play it with --dask local:N"
        )
    clients = live_clients(
        task.plan, task.options, task.endpoints, cache, ledger, stack=stack, share=task.share
    )
    for name, tokens in task.tokens.items():
        _, tpm = task.options.rates(task.plan.entries[name])
        if tpm is not None:
            await clients[name].limiter.acquire(min(tokens, int(tpm * task.share)))
    return LocalRunner(task.plan, clients, task.options.in_flight, task.first)


async def _cancel(work: asyncio.Task[None], stopping: threading.Event) -> None:
    while not stopping.is_set():  # noqa: ASYNC110 # another thread sets it
        await asyncio.sleep(STOP_EVERY_S)
    work.cancel()


# At the coordinator


@dataclass(eq=False)
class DaskTasks:
    """Plays trials on the workers of a cluster: one task for each of their threads at a time."""

    _client: Client
    _plan: Plan
    _options: Options
    _endpoints: EndpointPlan
    _cache: ResponseCache
    _ledger: Ledger
    first: FirstDecisions
    waits: Sequence[Wait] = ()
    _run: str = field(default_factory=lambda: secrets.token_hex(8))
    _numbers: Iterator[int] = field(default_factory=lambda: itertools.count(1))
    _ids: dict[str, str] = field(default_factory=dict)
    _threads: dict[str, int] = field(default_factory=dict)
    _groups: deque[list[TrialSpec]] = field(default_factory=deque)
    _tasks: dict[asyncio.Task[Played | None], _Given] = field(default_factory=dict)
    _used: list[tuple[float, dict[str, float]]] = field(default_factory=list)
    _losses: Counter[int] = field(default_factory=Counter)
    _is_short: bool = False
    _ended: Ended | None = None

    def __post_init__(self) -> None:
        self.meters = {name: Meter() for name in self._plan.entries}
        self._costs = trial_costs(self._plan, self._endpoints.measured)

    @property
    def workers(self) -> int:
        """How many workers there are."""
        return len(self._threads)

    @property
    def running(self) -> int:
        """How many trials are given out."""
        return sum(len(given.task.specs) for given in self._tasks.values())

    @property
    def unsaved(self) -> str:
        """What Ctrl-C waits for, in words."""
        return f"the replies of {len(self._tasks)} tasks"

    async def play(self, specs: Iterable[TrialSpec], ended: Ended, room: Room = no_wait) -> None:
        """Play trials in order; an error raised by ``ended`` or at a worker ends the run."""
        self._ended = ended
        groups: dict[tuple[object, ...], list[TrialSpec]] = {}
        for spec in specs:  # trials that may ask the same go together, so that one worker asks
            groups.setdefault((spec.condition, spec.repetition, spec.sample_set), []).append(spec)
        self._groups.extend(groups.values())
        while self._groups or self._tasks:
            await self._look()
            for address in self._idle():
                await room()
                await self._give(address)
            await self._collect()

    async def drain(self) -> None:
        """Stop the workers, and keep what their tasks have brought."""
        self._groups.clear()
        with contextlib.suppress(OSError):  # a timeout among them
            async with asyncio.timeout(GOODBYE_S):
                await self._client.run(stop, self._run, on_error="ignore")
        with contextlib.suppress(ClusterFailed):
            while self._tasks:
                await self._look()
                with contextlib.suppress(MergeRunnerError):  # the first error is told already
                    await self._collect()
                self._groups.clear()

    async def _look(self) -> None:
        """Find out which workers there are; raises UsageError for one with another program."""
        try:
            self._threads = dict(await self._client.nthreads())
        except OSError as exc:
            raise ClusterFailed(SCHEDULER_GONE) from exc
        told: dict[str, Any] = {}
        if new := [address for address in self._threads if address not in self._ids]:
            with contextlib.suppress(OSError):  # one that hangs is asked again
                async with asyncio.timeout(GOODBYE_S):
                    told = await self._client.run(introduce, workers=new, on_error="return")
        for address, answer in told.items():
            if isinstance(answer, (ImportError, AttributeError)):
                raise UsageError(
                    f"a Dask worker cannot load merge-runner ({answer}): install the same one for "
                    "all"
                )
            if isinstance(answer, BaseException):
                continue  # it is gone again
            self._ids[address], theirs, machine = answer
            if theirs != fingerprint():
                raise UsageError(
                    f"a Dask worker on {machine} has merge-runner {theirs}, and this is "
                    f"{fingerprint()}: install the same one for all, with the same plug-ins"
                )
        for address in self._ids.keys() - self._threads.keys():
            del self._ids[address]
        for work, given in list(self._tasks.items()):
            if self._ids.get(given.address) != given.task.worker:
                self._lose(self._tasks.pop(work))
                work.cancel()

    def _idle(self) -> list[str]:
        """The addresses of threads that may get a task now."""
        busy = Counter(given.address for given in self._tasks.values())
        free = [
            address for address in self._ids for _ in range(self._threads[address] - busy[address])
        ]
        # What is left of the cap when a share of it was too small goes to one task.
        most = 1 if self._is_short else self._options.in_flight
        return free[: max(0, min(most - len(self._tasks), len(self._groups)))]

    async def _give(self, address: str) -> None:
        """Give a task to a worker, unless those under way still hold all shares."""
        slots = 1 if self._is_short else min(sum(self._threads.values()), self._options.in_flight)
        free_share = 1.0 - sum(given.task.share for given in self._tasks.values())
        share = free_share / max(1, slots - len(self._tasks))
        if share < 1 / (2 * slots) or not self._groups:
            return
        in_flight = max(1, int(self._options.in_flight * share))
        idle = max(1, slots - len(self._tasks))
        left = sum(map(len, self._groups))
        size = min(TRIALS_PER_SEAT * in_flight, math.ceil(left / idle))
        specs = list(self._groups.popleft())
        while self._groups and len(specs) + len(self._groups[0]) <= size:
            specs += self._groups.popleft()
        recorded, unanswered = await self._recorded(specs)
        name, usd = f"task {self._run} {next(self._numbers)}", self._usd(specs, idle)
        if usd is not None:
            asked = Asked(f"Dask worker {address}", specs[0].trial_id, usd)
            self._ledger.reserve(name, 1, usd, None, asked)
        capped = self._options.max_cost_usd is not None
        task = Task(
            worker=self._ids[address],
            run=self._run,
            machine=socket.gethostname(),
            specs=specs,
            plan=self._plan,
            options=replace(
                self._options, in_flight=in_flight, max_cost_usd=usd if capped else None
            ),
            endpoints=self._endpoints,
            share=share,
            tokens=self._tokens(share / free_share),
            first=self.first.for_a_task(),
            recorded=recorded,
            unanswered=unanswered,
            overruns=self._ledger.spending.overruns,
        )
        # Dask must not retry it by itself: the share of the cap is spent once.
        future = self._client.submit(play_task, task, workers=[address], pure=False)
        given = _Given(task, address, name, usd, future, asyncio.get_running_loop().time())
        self._tasks[asyncio.create_task(_result(future))] = given

    def _usd(self, specs: Sequence[TrialSpec], idle: int) -> float | None:
        """The money for a task: a share of the cap, or what its trials are expected to cost."""
        if all(entry.price == "free" for entry in self._plan.entries.values()):
            return None
        spending, cap_usd = self._ledger.read(), self._options.max_cost_usd
        if cap_usd is None:
            return sum(self._costs(spec.order) for spec in specs)
        return max(0.0, cap_usd - spending.committed_usd) / idle

    def _tokens(self, part: float) -> dict[str, int]:
        """Take a part of the tokens that ended tasks have used within the last minute."""
        now = asyncio.get_running_loop().time()
        self._used = [(at, used) for at, used in self._used if now - at < WINDOW_S]
        taken: Counter[str] = Counter()
        for _, used in self._used:
            for name, tokens in used.items():
                taken[name] += math.ceil(part * tokens)
                used[name] = (1 - part) * tokens
        return dict(taken)

    async def _recorded(
        self, specs: Sequence[TrialSpec]
    ) -> tuple[list[CachedCall], dict[str, tuple[Attempt, ...]]]:
        """What the cache holds of the calls of these trials, up to the first that is missing."""
        player = LocalRunner(self._plan, sealed_clients(self._plan, self._cache), in_flight=1)
        recorded: dict[str, CachedCall] = {}
        unanswered: dict[str, tuple[Attempt, ...]] = {}
        for spec in specs:
            record = await player.play_one(spec)
            for row in record.decisions:
                if (reply := row.decision.reply) is not None:
                    recorded[reply.request.key] = CachedCall(reply.request, reply.attempts)
            for call in record.failed_calls:
                with contextlib.suppress(RecordingError):  # a damaged one is asked again
                    if attempts := self._cache.unanswered(call.request.key):
                        unanswered[call.request.key] = attempts
        return list(recorded.values()), unanswered

    async def _collect(self) -> None:
        """Wait a while for tasks, and keep what those that have ended return."""
        if not self._tasks:
            await asyncio.sleep(LOOK_EVERY_S)
            return
        done, _ = await asyncio.wait(
            self._tasks, timeout=LOOK_EVERY_S, return_when=asyncio.FIRST_COMPLETED
        )
        for work in done:
            given = self._tasks.pop(work)
            played = work.result()
            if played is None:
                self._ids.pop(given.address, None)
                self._lose(given)
            else:
                self._keep(given, played)

    def _keep(self, given: _Given, played: Played) -> None:
        """Keep what a task has brought: its replies first."""
        self._cache.put_now(played.replies, played.unanswered.items())
        self._ledger.settle_share(given.name, played.spent, played.opened)
        now = asyncio.get_running_loop().time()
        used: Counter[str] = Counter(played.tokens)
        if now - given.given_at < WINDOW_S:
            used.update(given.task.tokens)
        self._used.append((now, dict(used)))
        for name, meter in played.meters.items():
            self.meters[name].add(meter)
        self._take(given, played)
        if played.error is not None:
            raise type(played.error)(f"{played.error} (told by the worker {given.address})")

    def _take(self, given: _Given, played: Played) -> None:
        """Hand on the trials that have ended; those without money get what is left at the end."""
        assert self._ended is not None
        for record in played.records:
            self._ended(record.spec, record)
        for spec, why in played.suspended:
            if self._is_short and given.task.share == 1.0:
                self._ended(spec, TrialSuspended(why))
            else:
                self._groups.appendleft([spec])
        self._is_short |= bool(played.suspended)
        for record in played.records:
            asked = self._plan.by_label()[record.spec.arm].asked
            for row in record.decisions:
                if asked[row.side] in self._plan.entries:
                    self.first.count(asked[row.side], row.decision)

    def _lose(self, given: _Given) -> None:
        """Give the trials of a lost task out again; its share of the cap stays reserved."""
        specs = given.task.specs
        self._losses.update(spec.order for spec in specs)
        if max(self._losses[spec.order] for spec in specs) >= MOST_LOSSES:
            raise ClusterFailed(
                f"a task was begun on {MOST_LOSSES} Dask workers, and all died. Look at their "
                "memory and their logs; run the same command again to go on"
            )
        self._groups.appendleft(list(specs))
        next(iter(self.meters.values())).notes.append(
            f"the worker {given.address} is lost: its {len(specs)} trials go to others"
        )


async def _result(future: Future) -> Played | None:
    """Wait for a task; None where its worker died. Raises what a user can act on."""
    error: BaseException | None = await future.exception()
    if isinstance(error, KilledWorker):
        return None
    if future.status not in ("finished", "error"):
        raise ClusterFailed(SCHEDULER_GONE)
    if error is not None:
        raise error
    played: Played | None = await future.result()
    return played
