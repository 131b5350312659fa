"""A chunk of trials on a worker of a Dask cluster, played on the worker's event loop."""

from __future__ import annotations

import asyncio
import hashlib
import pickle
from collections.abc import Callable, Mapping, Sequence
from contextlib import AsyncExitStack, closing
from dataclasses import dataclass, field
from functools import cache, partial
from io import BytesIO
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

import merge_runner
from merge_runner.errors import MergeRunnerError, SweepStopped, TrialSuspended, UsageError
from merge_runner.llm.attempts import Meter
from merge_runner.llm.cache import ResponseCache
from merge_runner.llm.call import Calls
from merge_runner.llm.durable import Execute, Operation, ResultT
from merge_runner.llm.ledger import Cap, Ledger
from merge_runner.llm.limiter import Limiter
from merge_runner.llm.store import Attempts, CachedCall
from merge_runner.records import Usage
from merge_runner.registry import fault_of, plugin_sources, using
from merge_runner.run.clients import live_clients
from merge_runner.run.guard import FirstDecisions
from merge_runner.run.local_runner import LocalRunner
from merge_runner.run.options import Options
from merge_runner.run.parts import find_parts
from merge_runner.run.plan import Plan
from merge_runner.study.parts import catalogue_of
from merge_runner.trial_records import TrialRecord, TrialSpec

if TYPE_CHECKING:
    from distributed import Worker

# The coordinator may be slow, or its machine suspended; one that is gone never answers.
SILENT_S = 300
# Pickled operations of a chunk, and the rest of its share of the cap in USD.
Pending = tuple[list[bytes], float]


@dataclass(frozen=True, slots=True)
class Chunk:
    """Trials of a run for one worker, and its ``share`` of the rate limits.

    ``options`` have its share of the trials in flight, ``cap`` its share of the money. ``urls`` are
    the coordinator's base URLs. ``recorded`` are the calls with an answer, and by key the attempts
    at those without one.
    """

    run: str
    plan: Plan
    options: Options
    usage: Mapping[str, Usage | None]
    first: FirstDecisions
    urls: Mapping[str, str]
    share: float = 1.0
    cap: Cap | None = None
    specs: Sequence[TrialSpec] = ()
    recorded: tuple[Sequence[CachedCall], Sequence[tuple[str, Attempts]]] = ((), ())
    overruns: Mapping[str, float] = field(default_factory=dict)


@dataclass(slots=True)
class Played:
    """Result of a chunk; ``error`` is the text of what ended it, for an exit with ``exit_code``."""

    ended: list[tuple[TrialSpec, TrialRecord | TrialSuspended]] = field(default_factory=list)
    meters: Mapping[str, Meter] = field(default_factory=dict)
    error: str = ""
    exit_code: int = 0

    def fail(self, error: BaseException) -> None:
        """Note an error as text, since not every exception can be pickled."""
        if not isinstance(error, MergeRunnerError):
            error = SweepStopped(str(fault_of("a trial", error)))
        self.error, self.exit_code = str(error), error.exit_code


class _Pickler(pickle.Pickler):
    """Pickler of operations, which have names in place of the chunk's cache and ledgers."""

    def persistent_id(self, obj: Any) -> str | None:  # noqa: ANN401 # of any type
        if isinstance(obj, Ledger):
            return "ledger of " + obj.scope
        return "cache" if isinstance(obj, ResponseCache) else None


def unpickled(operation: bytes, stores: Mapping[str, object]) -> Operation:
    """Return an operation of a chunk for the coordinator's cache and ledgers, by their names."""
    unpickler = pickle.Unpickler(BytesIO(operation))  # noqa: S301 # a scheduler runs any code
    unpickler.persistent_load = stores.__getitem__  # type: ignore[method-assign] # as documented
    loaded: Operation = unpickler.load()
    return loaded


class RelayedCache(ResponseCache):
    """Cache and ledger of a chunk, in a folder until it is closed.

    The coordinator repeats each operation before its result is used.
    """

    def __init__(self, scope: str, cap: Cap | None) -> None:
        self._temporary = TemporaryDirectory(prefix="merge-runner-")
        super().__init__(Path(self._temporary.name))
        self.ledger = Ledger(self, scope, cap)
        # Pickled operations, and the futures of their results; None at the end.
        self._waiting = asyncio.Queue[tuple[bytes, asyncio.Future[Any]] | None]()
        self._sent: list[asyncio.Future[Any]] = []
        self._write_first = self.write
        self.write = lambda operation: asyncio.create_task(self._write(operation))

    async def _write(self, operation: Callable[[Execute], ResultT]) -> ResultT:
        result = await self._write_first(operation)
        if result is False:  # the chunk's share of the cap is used up
            return result
        pickled, repeated = BytesIO(), asyncio.get_running_loop().create_future()
        _Pickler(pickled).dump(operation)
        self._waiting.put_nowait((pickled.getvalue(), repeated))
        try:
            theirs: ResultT = await asyncio.wait_for(repeated, SILENT_S)
        except TimeoutError as exc:
            raise SweepStopped(f"the coordinator has said nothing for {SILENT_S} s") from exc
        return result if result == theirs else theirs

    def close(self) -> None:
        """Remove the folder; no operation is left."""
        super().close()
        self._temporary.cleanup()
        self._waiting.put_nowait(None)

    async def exchange(self, results: Sequence[Any]) -> Pending | None:
        """Set the results of the last operations; return the next ones, or None at the end."""
        for future, result in zip(self._sent, results, strict=True):
            if future.done():  # its call is cancelled
                continue
            if isinstance(result, BaseException):
                future.set_exception(result)
            else:
                future.set_result(result)
        taken = [await self._waiting.get()]
        while not self._waiting.empty():
            taken.append(self._waiting.get_nowait())
        if taken[-1] is None:
            return None
        operations, self._sent = map(list, zip(*filter(None, taken), strict=True))
        return operations, self.ledger.left_usd


@dataclass
class WorkerRun:
    """State of a run on a worker, from one chunk to the next; limiters are by share and model."""

    stopping: asyncio.Event = field(default_factory=asyncio.Event)
    limiters: dict[float, dict[str, Limiter]] = field(default_factory=dict)
    plan: Plan | None = None
    replies: RelayedCache = field(init=False)
    work: asyncio.Task[Played] = field(init=False)


def _state(run: str, worker: Worker) -> WorkerRun:
    state: WorkerRun = worker.extensions.setdefault(run, WorkerRun())
    return state


def stop(run: str, *, dask_worker: Worker) -> None:
    """Stop the chunk of a run: its calls end, and it returns its results so far."""
    _state(run, dask_worker).stopping.set()


@cache
def fingerprint() -> str:
    """Return the version and a hash of all source and plug-ins."""
    code = hashlib.sha256()
    for source in (Path(merge_runner.__file__).parent, *plugin_sources()):
        for path in sorted(source.rglob("*.py")) if source.is_dir() else [source]:
            code.update(f"{source.name}/{path.relative_to(source)}\0".encode() + path.read_bytes())
    return f"{merge_runner.__version__} ({code.hexdigest()[:12]})"


def forget(run: str, *, dask_worker: Worker) -> None:
    """Drop the state of a run that has ended."""
    dask_worker.extensions.pop(run, None)


async def begin_chunk(program: str, pickled: bytes, *, dask_worker: Worker) -> Pending | Played:
    """Begin to play a Chunk, which only a worker with the same ``program`` can read; see go_on."""
    if fingerprint() != program:
        differs = (
            f"it has merge-runner {fingerprint()}, and the coordinator {program}: install the same "
            "one for all, with the same plug-ins"
        )
        return Played(error=differs, exit_code=UsageError.exit_code)
    # Dask's profiler samples all threads; Python 3.11 can deadlock there.
    dask_worker.periodic_callbacks["profile"].stop()
    chunk: Chunk = pickle.loads(pickled)  # noqa: S301 # a scheduler runs any code
    state = _state(chunk.run, dask_worker)
    replies = state.replies = RelayedCache(chunk.plan.ledger, chunk.cap)
    replies.put_now(*chunk.recorded, [partial(replies.ledger.add_overruns, chunk.overruns)])
    state.work = asyncio.create_task(_play_chunk(chunk, state))
    return await go_on(chunk.run, [], dask_worker=dask_worker)


async def go_on(run: str, results: Sequence[Any], *, dask_worker: Worker) -> Pending | Played:
    """Give a chunk the results of operations; return its next ones, or its result at its end."""
    state = _state(run, dask_worker)
    return await state.replies.exchange(results) or await state.work


async def _play_chunk(chunk: Chunk, state: WorkerRun) -> Played:
    replies, played = state.replies, Played()

    def ended(spec: TrialSpec, record: TrialRecord | TrialSuspended) -> None:
        if isinstance(record, TrialSuspended):
            record = TrialSuspended(str(record))  # without its frames, which no pickle can hold
        played.ended.append((spec, record))

    async with AsyncExitStack() as stack:
        stack.enter_context(closing(replies))
        try:
            if state.plan is None:
                source, arms, conditions = chunk.plan.study, chunk.plan.arms, chunk.plan.conditions
                catalogue = catalogue_of(source.file, source.text, source.plugins)
                parts = find_parts(arms, conditions, catalogue)
                state.plan = chunk.plan.model_copy(update={"parts": parts})
            plan, options, calls = state.plan, chunk.options, Calls()
            stack.enter_context(using(plan.parts.catalogue))
            clients = live_clients(
                plan, options, chunk.usage, replies, replies.ledger, calls=calls, stack=stack,
                urls=chunk.urls, share=chunk.share,
                limiters=state.limiters.setdefault(chunk.share, {}),
            )  # fmt: skip
            runner = LocalRunner(plan, clients, options.in_flight, chunk.first, calls=calls)
            played.meters = runner.meters
            work = asyncio.create_task(runner.play(chunk.specs, ended))
            stopped = asyncio.create_task(state.stopping.wait())
            await asyncio.wait([work, stopped], return_when=asyncio.FIRST_COMPLETED)
            work.cancel()
            stopped.cancel()
            await asyncio.wait([work])
            await runner.drain()
            # Of whatever kind: the trials that have ended go to the coordinator all the same.
            error = None if work.cancelled() else work.exception()
        except MergeRunnerError as exc:
            error = exc
        if error is not None:
            played.fail(error)
    return played
