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
import hashlib
import logging
import math
import os
import pickle
import re
import secrets
import signal
from collections import Counter, deque
from collections.abc import AsyncIterator, Iterable, Iterator, Mapping, Sequence
from contextlib import AsyncExitStack, asynccontextmanager, closing, contextmanager
from dataclasses import dataclass, field, replace
from functools import cache, partial
from multiprocessing import resource_tracker
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

import merge_runner
from merge_runner.errors import (
    MergeRunnerError,
    RecordingError,
    SweepStopped,
    TrialSuspended,
    UsageError,
)
from merge_runner.llm.attempts import Meter
from merge_runner.llm.cache import ResponseCache
from merge_runner.llm.call import Calls, Wait
from merge_runner.llm.durable import Rows
from merge_runner.llm.ledger import CallLabel, Cap, Ledger
from merge_runner.llm.limiter import Limiter
from merge_runner.llm.store import CachedCall
from merge_runner.providers import base_urls
from merge_runner.records import Attempt, Usage
from merge_runner.registry import plugin_sources, using
from merge_runner.run.clients import live_clients
from merge_runner.run.guard import FirstDecisions
from merge_runner.run.local_runner import LocalRunner
from merge_runner.run.plan import Options, Plan
from merge_runner.run.replay import Replay
from merge_runner.run.trials import Ended, Room
from merge_runner.study.parts import catalogue_of
from merge_runner.trial_records import TrialRecord, TrialSpec

if TYPE_CHECKING:
    from distributed import Client, Worker

CONNECT_TIMEOUT_S = 10
# Workers may come and go: how often they are counted.
LOOK_EVERY_S = 1.0
# A worker that dies loses so many times its trials in flight, and the longest trial of a task
# holds the others up.
TRIALS_PER_SEAT = 4
MOST_LOSSES = 3
# A coordinator that stands still is waited for; one that is gone has no use for what is asked.
SILENT_S = 300
_WHERE = re.compile(
    r"local:(?P<workers>[1-9]\d*)|(?P<file>.+\.json)|((tcp|tls)://)?(?!local:)[^\s/]+:[1-9]\d*",
    re.ASCII,
)
VALID = (
    "valid: local:N (N workers on this machine), a scheduler's tcp://HOST:PORT or tls://HOST:PORT, "
    "or its file PATH.json"
)


# Those with a level of their own: Dask logs tracebacks for what we report in a line, such as lost
# workers, and so do the libraries below it.
LOGGERS = ("distributed", "distributed.client", "tornado", "tornado.application")


@contextmanager
def _silenced(loggers: Iterable[logging.Logger]) -> Iterator[None]:
    """Let loggers say nothing for a while."""
    levels = [(logger, logger.level) for logger in loggers]
    try:
        for logger, _ in levels:
            logger.setLevel(logging.CRITICAL + 1)
        yield
    finally:
        for logger, level in levels:
            logger.setLevel(level)


@contextmanager
def _environment_restored() -> Iterator[None]:
    """Undo what is set meanwhile: Dask sets variables of this process for those it starts."""
    before = {**os.environ}
    try:
        yield
    finally:
        for name in {*os.environ} - {*before}:
            del os.environ[name]
        os.environ.update(before)


@asynccontextmanager
async def connected(where: str) -> AsyncIterator[Client]:
    """Connect to the cluster that ``--dask`` names, or start a local one; raises UsageError."""
    named = _WHERE.fullmatch(where)
    is_file = Path(where).is_file()  # noqa: ASYNC240 # nothing else runs yet
    if named is None or (named["file"] and not is_file):
        raise UsageError(f"--dask {where!r} names no cluster; {VALID}")
    try:
        import distributed
    except ModuleNotFoundError as exc:
        raise UsageError(
            "--dask needs the package distributed: pip install 'merge-runner[dask]'"
        ) from exc

    async with AsyncExitStack() as stack:
        stack.enter_context(_silenced(map(logging.getLogger, LOGGERS)))
        scheduler = {"scheduler_file" if named["file"] else "address": where}
        if named["workers"]:
            stack.enter_context(_environment_restored())
            os.environ["PYTHONSAFEPATH"] = "1"  # workers import nothing of this folder
            # A terminal's Ctrl-C reaches this process alone, which stops them in order: children
            # inherit what is blocked. The tracker, if it were started meanwhile, would unblock it.
            resource_tracker.ensure_running()
            before = signal.pthread_sigmask(signal.SIG_BLOCK, (signal.SIGINT, signal.SIGHUP))
            try:
                local = distributed.LocalCluster(
                    n_workers=int(named["workers"]),
                    threads_per_worker=1,
                    dashboard_address=None,
                    # Its server of HTTP is started all the same: at any port that is free.
                    scheduler_kwargs={"dashboard_address": "127.0.0.1:0"},
                    silence_logs=logging.CRITICAL,
                    asynchronous=True,
                )
                cluster = await stack.enter_async_context(local)
            finally:
                signal.pthread_sigmask(signal.SIG_SETMASK, before)
            scheduler = {"address": str(cluster.scheduler_address)}
        client = distributed.Client(**scheduler, asynchronous=True, timeout=CONNECT_TIMEOUT_S)
        try:
            await client
        except (OSError, ValueError) as exc:
            raise UsageError(
                f"no Dask scheduler answers at {where} within {CONNECT_TIMEOUT_S} s; {VALID}"
            ) from exc
        stack.push_async_callback(client.close, timeout=CONNECT_TIMEOUT_S)
        if named["workers"]:  # the first of them would get the share of all
            await client.wait_for_workers(int(named["workers"]))
        yield client


# The calls with an answer, and by key the attempts at those without one.
Recorded = tuple[Sequence[CachedCall], Sequence[tuple[str, tuple[Attempt, ...]]]]


@dataclass(frozen=True, slots=True)
class Task:
    """Trials for one worker, what is recorded of their calls, and its ``share`` of the limits.

    What it spends is reserved under its ``name`` until it ends. ``urls`` are the coordinator's base
    URLs.
    """

    run: str
    name: str
    specs: Sequence[TrialSpec]
    plan: Plan
    options: Options
    cap: Cap | None
    urls: Mapping[str, str]
    earlier: Mapping[str, Usage | None]
    share: float
    first: FirstDecisions
    recorded: Recorded
    overruns: Sequence[tuple[str, float]]


@dataclass(slots=True)
class Played:
    """What a worker returns: ``spent`` and ``opened`` are rows of its ledger."""

    ended: list[tuple[TrialSpec, TrialRecord | TrialSuspended]] = field(default_factory=list)
    recorded: Recorded = ((), ())
    spent: Rows = field(default_factory=list)
    opened: Rows = field(default_factory=list)
    meters: Mapping[str, Meter] = field(default_factory=dict)
    error: MergeRunnerError | None = None


@cache
def fingerprint() -> str:
    """Return the version and a hash of all source and plug-ins."""
    code = hashlib.sha256()
    for source in (Path(merge_runner.__file__).parent, *plugin_sources()):
        for path in sorted(source.rglob("*.py")) if source.is_dir() else [source]:
            code.update(f"{source.name}/{path.relative_to(source)}\0".encode() + path.read_bytes())
    return f"{merge_runner.__version__} ({code.hexdigest()[:12]})"


# At a worker, on its event loop


@dataclass(slots=True)
class Told:
    """What a task tells the coordinator: attempts to reserve, by number, and costs that are known.

    After the last one it is ``done``.
    """

    asking: dict[int, tuple[float, CallLabel]] = field(default_factory=dict)
    costs: dict[int, float] = field(default_factory=dict)
    done: bool = False


class Desk:
    """Where a task waits until the coordinator has reserved its attempts."""

    def __init__(self) -> None:
        self.told = Told()
        self.changed = asyncio.Event()
        self._begun = 0
        self._answers: dict[int, asyncio.Future[bool]] = {}

    async def ask(self, usd: float, label: CallLabel) -> tuple[int, bool]:
        """Return an attempt's number and whether there is money for it; raises SweepStopped."""
        number = self._begun = self._begun + 1
        answer = self._answers[number] = asyncio.get_running_loop().create_future()
        self.told.asking[number] = (usd, label)
        self.changed.set()
        try:
            async with asyncio.timeout(SILENT_S):
                return number, await answer
        except TimeoutError as exc:
            raise SweepStopped(f"the coordinator has said nothing for {SILENT_S} s") from exc
        except asyncio.CancelledError:
            if self.told.asking.pop(number, None) is None:  # the coordinator may have reserved it
                self.cost(number, 0.0)
            raise
        finally:
            del self._answers[number]

    def cost(self, number: int, usd: float) -> None:
        """Tell what an attempt has cost."""
        self.told.costs[number] = usd
        self.changed.set()

    def close(self) -> None:
        """Tell that the task has ended."""
        self.told.done = True
        self.changed.set()

    async def exchange(self, answers: Mapping[int, bool]) -> Told:
        """Take the coordinator's answers, and return what is new since then."""
        for number, answer in answers.items():
            if number in self._answers and not self._answers[number].done():
                self._answers[number].set_result(answer)
        await self.changed.wait()
        self.changed.clear()
        told, self.told = self.told, Told(done=self.told.done)
        return told


class ToldLedger(Ledger):
    """A worker's ledger, whose attempts the coordinator reserves before they begin."""

    is_shared_out = True

    def __init__(
        self, store: ResponseCache, scope: str, desk: Desk, cap: Cap | None = None
    ) -> None:
        super().__init__(store, scope, cap)
        self._desk = desk
        self._numbers: dict[str, int] = {}  # by key of a call, which has one attempt at a time

    async def ask_coordinator(self, key: str, usd: float, label: CallLabel) -> bool:
        """Let the coordinator reserve an attempt; False if that exceeds the cap."""
        number, is_paid = await self._desk.ask(usd, label)
        if is_paid:
            self._numbers[key] = number
        return is_paid

    def report_cost(self, key: str, usd: float | None) -> None:
        """Tell what an attempt that may be reserved has cost, where that is known."""
        number = self._numbers.pop(key, None)
        if number is not None and usd is not None:
            self._desk.cost(number, usd)


async def exchange(name: str, answers: Mapping[int, bool], *, dask_worker: Worker) -> Told:
    """Take the coordinator's answers to a task, and return what it asks and tells next."""
    desk: Desk = dask_worker.extensions.setdefault(name, Desk())
    told = await desk.exchange(answers)
    if told.done:
        del dask_worker.extensions[name]
    return told


def stop(run: str, *, dask_worker: Worker) -> None:
    """Let the calls of a run's tasks end, and return what there is."""
    dask_worker.extensions.setdefault(run, asyncio.Event()).set()


async def play_task(program: str, pickled: bytes, name: str, *, dask_worker: Worker) -> Played:
    """Play the Task of a name, which only a worker with the same ``program`` can read."""
    desk: Desk = dask_worker.extensions.setdefault(name, Desk())
    try:
        return await _play_task(program, pickled, dask_worker)
    finally:
        desk.close()


async def _play_task(program: str, pickled: bytes, dask_worker: Worker) -> Played:
    if fingerprint() != program:
        differs = UsageError(
            f"it has merge-runner {fingerprint()}, and the coordinator {program}: install the same "
            "one for all, with the same plug-ins"
        )
        return Played(error=differs)
    # Dask's profiler samples all threads; Python 3.11 can deadlock there.
    dask_worker.periodic_callbacks["profile"].stop()
    task: Task = pickle.loads(pickled)  # noqa: S301 # whoever reaches a scheduler can run code
    kept = dask_worker.extensions
    try:
        if (plan := kept.get(f"{task.run} plan")) is None:
            plan = kept[f"{task.run} plan"] = _rebuilt(task.plan)
    except MergeRunnerError as exc:
        return Played(error=type(exc)(str(exc)))
    with using(plan.parts.catalogue):
        return await _play(replace(task, plan=plan), kept)


def _rebuilt(plan: Plan) -> Plan:
    """The plan with its programs, and all that its study adds, made anew from their sources."""
    study = plan.study
    catalogue = catalogue_of(study.file, study.text, study.plugins)
    return plan.model_copy(update={"parts": plan.parts.with_code(plan.arms, catalogue)})


async def _play(task: Task, kept: dict[str, Any]) -> Played:
    stopping: asyncio.Event = kept.setdefault(task.run, asyncio.Event())
    # What the last task asked within a minute counts for this one, too.
    limiters: dict[str, Limiter] = kept.setdefault(f"{task.run} {task.share}", {})
    played = Played()

    def ended(spec: TrialSpec, record: TrialRecord | TrialSuspended) -> None:
        if isinstance(record, TrialSuspended):
            record = TrialSuspended(str(record))  # without its frames, which no pickle can hold
        played.ended.append((spec, record))

    async with AsyncExitStack() as stack:
        folder = Path(stack.enter_context(TemporaryDirectory(prefix="merge-runner-")))
        replies = stack.enter_context(closing(ResponseCache(folder)))
        desk = kept.setdefault(task.name, Desk())
        ledger = ToldLedger(replies, task.plan.ledger, desk, task.cap)
        overruns = [(driver, 0, 0, ratio) for driver, ratio in task.overruns]
        replies.put_now(*task.recorded, [partial(ledger.share, "", overruns, [])])
        try:
            calls = Calls()
            clients = live_clients(
                task.plan, task.options, task.earlier, replies, ledger,
                calls=calls, stack=stack, urls=task.urls, share=task.share, limiters=limiters,
            )  # fmt: skip
            in_flight = task.options.in_flight
            runner = LocalRunner(task.plan, clients, in_flight, task.first, calls=calls)
            played.meters = runner.meters
            work = asyncio.create_task(runner.play(task.specs, ended))
            stopped = asyncio.create_task(stopping.wait())
            await asyncio.wait([work, stopped], return_when=asyncio.FIRST_COMPLETED)
            work.cancel()
            stopped.cancel()
            await asyncio.wait([work])
            await runner.drain()
            if not work.cancelled():
                work.result()
        except MergeRunnerError as exc:
            played.error = type(exc)(str(exc))
        known = {call.request.key for call in task.recorded[0]}
        new = [call for call in replies.entries() if call.request.key not in known]
        played.recorded = new, [*replies.all_unanswered().items()]
        played.spent, played.opened = ledger.rows()
    return played


# At the coordinator


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
        self._ledger.read()
        cap = self._ledger.cap
        if cap is not None:
            kept_usd = sum(
                max(0.0, task.cap.usd - sum(self._begun[task.name].values()))
                for task, _ in self._given.values()
                if task.cap is not None
            )
            share_usd = max(0.0, self._ledger.left_usd - kept_usd) / idle
            cap = Cap(share_usd, f"a task's share of {cap.source}")
        task = Task(
            run=self._run,
            name=name,
            specs=specs,
            plan=self._sent,
            options=replace(self._options, in_flight=in_flight),
            cap=cap,
            urls=base_urls(self._plan.entries),
            earlier=self._earlier,
            share=1 / slots,
            first=self.first,
            recorded=recorded,
            overruns=[*self._ledger.spending.overruns.items()],
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
        answers, drivers = dict[int, bool](), dict[int, str]()
        while True:
            told = (
                await self._client.run(
                    exchange, task.name, answers, workers=[address], on_error="return"
                )
            )[address]
            if not isinstance(told, Told):
                return  # lost, as the task is
            drivers.update({number: label.driver for number, (_, label) in told.asking.items()})
            costs = [
                partial(ledger.pay, task.name, number, usd, drivers[number])
                for number, usd in told.costs.items()
            ]
            worst = [
                partial(ledger.reserve, task.name, number, usd, label)
                for number, (usd, label) in told.asking.items()
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
