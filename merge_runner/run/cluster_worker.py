"""A chunk of trials on a worker of a Dask cluster, played on the worker's event loop."""

from __future__ import annotations

import asyncio
import hashlib
import pickle
from collections.abc import Mapping, Sequence
from contextlib import AsyncExitStack, closing
from dataclasses import dataclass, field, replace
from functools import cache, partial
from itertools import count
from pathlib import Path
from tempfile import TemporaryDirectory
from traceback import walk_tb
from typing import TYPE_CHECKING

import merge_runner
from merge_runner.errors import MergeRunnerError, SweepStopped, TrialSuspended, UsageError
from merge_runner.llm.attempts import Meter
from merge_runner.llm.cache import ResponseCache
from merge_runner.llm.call import Calls
from merge_runner.llm.durable import Rows
from merge_runner.llm.ledger import CallLabel, Cap, Ledger
from merge_runner.llm.limiter import Limiter
from merge_runner.llm.store import CachedCall
from merge_runner.records import Attempt, Usage
from merge_runner.registry import plugin_sources, using
from merge_runner.run.clients import live_clients
from merge_runner.run.guard import FirstDecisions
from merge_runner.run.local_runner import LocalRunner
from merge_runner.run.options import Options
from merge_runner.run.plan import Plan
from merge_runner.study.parts import catalogue_of
from merge_runner.text_safety import one_line
from merge_runner.trial_records import TrialRecord, TrialSpec

if TYPE_CHECKING:
    from distributed import Worker

# The coordinator may be slow, or its machine suspended; one that is gone never answers.
SILENT_S = 300
# The calls with an answer, and by key the attempts at those without one.
StoredCalls = tuple[Sequence[CachedCall], Sequence[tuple[str, tuple[Attempt, ...]]]]


@dataclass(frozen=True, slots=True)
class RunSetup:
    """A run and how it is played; ``urls`` are the coordinator's base URLs."""

    run: str
    plan: Plan
    options: Options
    usage: Mapping[str, Usage | None]
    first: FirstDecisions
    urls: Mapping[str, str]


@dataclass(frozen=True, slots=True)
class Chunk:
    """Trials for one worker, their recorded calls, and its ``share`` of the rate limits.

    Its attempts are reserved under its ``name`` until it ends. The options of ``setup`` have its
    share of the trials in flight, and ``cap`` its share of the money.
    """

    name: str
    setup: RunSetup
    cap: Cap | None
    specs: Sequence[TrialSpec]
    share: float
    calls: StoredCalls
    overruns: Sequence[tuple[str, float]]


@dataclass(slots=True)
class Played:
    """Result of a chunk; ``spent`` and ``opened`` are rows of the worker's ledger.

    ``error`` is the text of what ended it, for a run that exits with ``exit_code``.
    """

    ended: list[tuple[TrialSpec, TrialRecord | TrialSuspended]] = field(default_factory=list)
    calls: StoredCalls = ((), ())
    spent: Rows = field(default_factory=list)
    opened: Rows = field(default_factory=list)
    meters: Mapping[str, Meter] = field(default_factory=dict)
    error: str = ""
    exit_code: int = 0

    def fail(self, error: BaseException) -> None:
        """Note an error as text, since not every exception can be pickled."""
        if isinstance(error, MergeRunnerError):
            self.error, self.exit_code = str(error), error.exit_code
        else:
            self.error, self.exit_code = _described(error), SweepStopped.exit_code


@dataclass(frozen=True, slots=True)
class MoneyEvent:
    """An attempt that waits until its worst case is reserved, or the cost of one that is."""

    number: int
    usd: float
    label: CallLabel
    is_cost: bool


class RemoteCoordinator:
    """Coordinator of a chunk, which reserves its attempts before they are sent.

    ``go_on`` gives it the ``events`` once they have ``changed``; the attempts ``waiting`` for its
    answers are by number.
    """

    def __init__(self) -> None:
        self.events: list[MoneyEvent] = []
        self.changed = asyncio.Event()  # also at the end of the chunk
        self.waiting: dict[int, asyncio.Future[bool]] = {}
        self.work: asyncio.Task[Played] | None = None
        self._numbers = count(1)
        self._reserved: dict[str, tuple[int, CallLabel]] = {}  # a call has one attempt at a time

    def _tell(self, number: int, usd: float, label: CallLabel, *, is_cost: bool = False) -> None:
        self.events.append(MoneyEvent(number, usd, label, is_cost))
        self.changed.set()

    async def reserve(self, key: str, usd: float, label: CallLabel) -> bool:
        """Return whether an attempt is reserved; False if it exceeds the cap."""
        number = next(self._numbers)
        answer = self.waiting[number] = asyncio.get_running_loop().create_future()
        self._tell(number, usd, label)
        try:
            async with asyncio.timeout(SILENT_S):
                is_paid: bool = await answer
        except TimeoutError as exc:
            raise SweepStopped(f"the coordinator has said nothing for {SILENT_S} s") from exc
        except asyncio.CancelledError:
            self._tell(number, 0.0, label, is_cost=True)  # it may be reserved
            raise
        finally:
            del self.waiting[number]
        if is_paid:
            self._reserved[key] = number, label
        return is_paid

    def report_cost(self, key: str, usd: float | None) -> None:
        """Report the cost of an attempt that may be reserved, where it is known."""
        number, label = self._reserved.pop(key, (0, CallLabel()))
        if number and usd is not None:
            self._tell(number, usd, label, is_cost=True)


@dataclass
class WorkerRun:
    """State of a run on a worker, from one chunk to the next; limiters are by share and model."""

    stopping: asyncio.Event = field(default_factory=asyncio.Event)
    limiters: dict[float, dict[str, Limiter]] = field(default_factory=dict)
    plan: Plan | None = None
    # By the name of a chunk under way.
    chunks: dict[str, RemoteCoordinator] = field(default_factory=dict)


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


async def begin_chunk(program: str, pickled: bytes, *, dask_worker: Worker) -> Played | None:
    """Begin to play a Chunk, which only a worker with the same ``program`` can read.

    Returns the result of one that cannot be played.
    """
    if fingerprint() != program:
        differs = (
            f"it has merge-runner {fingerprint()}, and the coordinator {program}: install the same "
            "one for all, with the same plug-ins"
        )
        return Played(error=differs, exit_code=UsageError.exit_code)
    # Dask's profiler samples all threads; Python 3.11 can deadlock there.
    dask_worker.periodic_callbacks["profile"].stop()
    chunk: Chunk = pickle.loads(pickled)  # noqa: S301 # a scheduler runs any code
    state = _state(chunk.setup.run, dask_worker)
    try:
        if state.plan is None:
            state.plan = _with_code(chunk.setup.plan)
    except MergeRunnerError as exc:
        return Played(error=str(exc), exit_code=exc.exit_code)
    chunk = replace(chunk, setup=replace(chunk.setup, plan=state.plan))
    coordinator = state.chunks[chunk.name] = RemoteCoordinator()
    with using(state.plan.parts.catalogue):
        coordinator.work = asyncio.create_task(_play(chunk, state, coordinator))
    coordinator.work.add_done_callback(lambda _: coordinator.changed.set())
    return None


async def go_on(
    run: str, name: str, answers: Mapping[int, bool], *, dask_worker: Worker
) -> tuple[list[MoneyEvent], Played | None]:
    """Give a chunk the coordinator's answers; return its next events, and its result at its end."""
    chunks = _state(run, dask_worker).chunks
    coordinator = chunks[name]
    for number, is_paid in answers.items():
        if number in coordinator.waiting and not coordinator.waiting[number].done():
            coordinator.waiting[number].set_result(is_paid)
    await coordinator.changed.wait()
    coordinator.changed.clear()
    events, coordinator.events = coordinator.events, []
    if coordinator.work is None or not coordinator.work.done():
        return events, None
    del chunks[name]
    return events, coordinator.work.result()


def _with_code(plan: Plan) -> Plan:
    """Return the plan with its programs and its study's parts, made from their sources."""
    study = plan.study
    catalogue = catalogue_of(study.file, study.text, study.plugins)
    return plan.model_copy(update={"parts": plan.parts.with_code(plan.arms, catalogue)})


async def _play(chunk: Chunk, state: WorkerRun, coordinator: RemoteCoordinator) -> Played:
    setup, played = chunk.setup, Played()

    def ended(spec: TrialSpec, record: TrialRecord | TrialSuspended) -> None:
        if isinstance(record, TrialSuspended):
            record = TrialSuspended(str(record))  # without its frames, which no pickle can hold
        played.ended.append((spec, record))

    async with AsyncExitStack() as stack:
        folder = Path(stack.enter_context(TemporaryDirectory(prefix="merge-runner-")))
        replies = stack.enter_context(closing(ResponseCache(folder)))
        ledger = Ledger(replies, setup.plan.ledger, chunk.cap, coordinator)
        overruns = [(driver, 0, 0, ratio) for driver, ratio in chunk.overruns]
        replies.put_now(*chunk.calls, [partial(ledger.share, "", overruns, [])])
        try:
            calls = Calls()
            clients = live_clients(
                setup.plan, setup.options, setup.usage, replies, ledger, calls=calls, stack=stack,
                urls=setup.urls, share=chunk.share,
                limiters=state.limiters.setdefault(chunk.share, {}),
            )  # fmt: skip
            in_flight = setup.options.in_flight
            runner = LocalRunner(setup.plan, clients, in_flight, setup.first, calls=calls)
            played.meters = runner.meters
            work = asyncio.create_task(runner.play(chunk.specs, ended))
            stopped = asyncio.create_task(state.stopping.wait())
            await asyncio.wait([work, stopped], return_when=asyncio.FIRST_COMPLETED)
            work.cancel()
            stopped.cancel()
            await asyncio.wait([work])
            await runner.drain()
            # Of whatever kind: the replies that are paid go to the coordinator all the same.
            error = None if work.cancelled() else work.exception()
        except MergeRunnerError as exc:
            error = exc
        if error is not None:
            played.fail(error)
        known = {call.request.key for call in chunk.calls[0]}
        new = [call for call in replies.entries() if call.request.key not in known]
        played.calls = new, [*replies.all_unanswered().items()]
        played.spent, played.opened = ledger.rows()
    return played


def _described(error: BaseException) -> str:
    """Return an error of foreign code, such as a driver's, in one line with its place."""
    frames = [frame for frame, _ in walk_tb(error.__traceback__)]
    package = Path(merge_runner.__file__).parent
    foreign = (f for f in frames if package not in Path(f.f_code.co_filename).parents)
    code = next(foreign, frames[-1]).f_code
    return one_line(f"{code.co_qualname} of {code.co_filename} raised {error!r}")
