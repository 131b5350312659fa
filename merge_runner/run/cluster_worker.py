"""Plays a task of a Dask cluster, on the event loop of its worker."""

from __future__ import annotations

import asyncio
import hashlib
import pickle
from collections.abc import Mapping, Sequence
from contextlib import AsyncExitStack, closing
from dataclasses import dataclass, field, replace
from functools import cache, partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

import merge_runner
from merge_runner.errors import (
    MergeRunnerError,
    SweepStopped,
    TrialSuspended,
    UsageError,
)
from merge_runner.llm.cache import CachedCall, ResponseCache
from merge_runner.llm.call import Meter
from merge_runner.llm.durable import Rows
from merge_runner.llm.ledger import Asked, Ledger
from merge_runner.llm.limiter import Limiter
from merge_runner.records import Attempt, TrialRecord, TrialSpec, Usage
from merge_runner.registry import plugin_sources, using
from merge_runner.run.clients import live_clients
from merge_runner.run.guard import FirstDecisions
from merge_runner.run.local_runner import LocalRunner
from merge_runner.run.plan import Options, Plan
from merge_runner.study.parts import catalogue_of

if TYPE_CHECKING:
    from distributed import Worker

# A coordinator that stands still is waited for; one that is gone has no use for what is asked.
SILENT_S = 300
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


@dataclass(slots=True)
class Told:
    """What a task tells the coordinator: attempts to reserve, by number, and costs that are known.

    After the last one it is ``done``.
    """

    asking: dict[int, tuple[float, Asked]] = field(default_factory=dict)
    costs: dict[int, float] = field(default_factory=dict)
    done: bool = False


class Desk:
    """Where a task waits until the coordinator has reserved its attempts."""

    def __init__(self) -> None:
        self.told = Told()
        self.changed = asyncio.Event()
        self._begun = 0
        self._answers: dict[int, asyncio.Future[bool]] = {}

    async def ask(self, usd: float, asked: Asked) -> tuple[int, bool]:
        """Return an attempt's number and whether there is money for it; raises SweepStopped."""
        number = self._begun = self._begun + 1
        answer = self._answers[number] = asyncio.get_running_loop().create_future()
        self.told.asking[number] = (usd, asked)
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

    def __init__(self, store: ResponseCache, scope: str, desk: Desk) -> None:
        super().__init__(store, scope)
        self._desk = desk
        self._numbers: dict[str, int] = {}  # by key of a call, which has one attempt at a time

    async def ask(self, key: str, usd: float, asked: Asked) -> bool:
        """Let the coordinator reserve an attempt; False if that exceeds the cap."""
        number, is_paid = await self._desk.ask(usd, asked)
        if is_paid:
            self._numbers[key] = number
        return is_paid

    def ended(self, key: str, usd: float | None) -> None:
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
        ledger = ToldLedger(replies, task.plan.ledger, kept.setdefault(task.name, Desk()))
        overruns = [(driver, 0, 0, ratio) for driver, ratio in task.overruns]
        replies.put_now(*task.recorded, [partial(ledger.share, "", overruns, [])])
        try:
            clients = live_clients(
                task.plan, task.options, task.earlier, replies, ledger,
                stack=stack, urls=task.urls, share=task.share, limiters=limiters,
            )  # fmt: skip
            runner = LocalRunner(task.plan, clients, task.options.in_flight, task.first)
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
