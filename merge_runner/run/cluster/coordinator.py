"""Hands batches of trials to the workers of a cluster, and alone stores what they send back.

Dask decides where a batch is played, and starts it again elsewhere when its worker dies. Which
trials a batch holds is decided when it starts: the next ones in the order of the sweep. Those of a
lost worker go back to the front.
"""

from __future__ import annotations

import asyncio
import contextlib
import math
import secrets
import socket
from collections import Counter, deque
from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

from distributed import Client, Future
from distributed.comm import Comm, get_address_host, listen
from distributed.scheduler import KilledWorker

from merge_runner.errors import (
    ClusterFailed,
    MergeRunnerError,
    TrialSuspended,
    UsageError,
)
from merge_runner.llm.meter import Meter
from merge_runner.run.cluster.batch import Batch, fingerprint
from merge_runner.run.cluster.session import Session
from merge_runner.run.cluster.worker import play_batch
from merge_runner.run.local_runner import no_wait

if TYPE_CHECKING:
    from types import TracebackType

    from merge_runner.llm.cache import ResponseCache
    from merge_runner.llm.call import Wait
    from merge_runner.records import TrialRecord, TrialSpec
    from merge_runner.run.clients import EndpointPlan, LocalServices
    from merge_runner.run.local_runner import Ended, Room
    from merge_runner.run.plan import Plan

# Workers may come and go: how often they are counted.
LOOK_EVERY_S = 1.0
# A scheduler that hangs must not keep Ctrl-C from ending the run.
GOODBYE_S = 5.0
BATCHES_PER_WORKER = 4
SCHEDULER_GONE = (
    "the Dask scheduler is gone. Every reply that the workers sent is saved; run the same command "
    "again to go on"
)


class Coordinator:
    """Plays trials on the workers of a Dask cluster; see TrialRunner.

    ``in_flight`` trials are played at once over all workers. A worker's thread is a slot: one
    batch at a time.
    """

    def __init__(
        self,
        client: Client,
        plan: Plan,
        endpoint_plan: EndpointPlan,
        cache: ResponseCache,
        services: LocalServices,
        in_flight: int,
    ) -> None:
        self.services = services
        self.cache = cache
        self.answered: Counter[str] = Counter()
        self.meters = {name: Meter() for name in plan.entries}
        self.workers = 0
        self.playing = None
        self._client = client
        self._plan = plan
        self._endpoint_plan = endpoint_plan
        self._in_flight = in_flight
        # A task that an earlier run has left must not join this one, should it use the same port.
        self._token = secrets.token_hex(16)
        self._waiting: deque[TrialSpec] = deque()
        self._unfinished: set[int] = set()
        self._ended: Ended | None = None
        self._room: Room = no_wait
        self._slots = 1
        self._sessions: dict[Session, asyncio.Task[None]] = {}
        self._free = in_flight
        self._freed = asyncio.Event()
        self._batches: dict[asyncio.Task[None], Future] = {}
        self._failure: asyncio.Future[None] = asyncio.get_running_loop().create_future()
        self._failure.add_done_callback(lambda failed: failed.exception())  # it is retrieved
        self._stopping = False

    async def __aenter__(self) -> Coordinator:
        """Listen where the scheduler reaches this process."""
        scheduler = self._client.scheduler.address
        protocol = scheduler.partition("://")[0]
        host = get_address_host(self._client.scheduler_comm.comm.local_address)
        self._listener = listen(
            f"{protocol}://{host}:0",
            self._serve,
            **self._client.security.get_listen_args("client"),
        )
        await self._listener.start()
        return self

    async def __aexit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self._listener.stop()
        for session in self._sessions:
            session.link.abort()
        await asyncio.gather(*self._sessions.values(), return_exceptions=True)

    @property
    def running(self) -> int:
        """How many trials are being played, as the workers told last."""
        return sum(session.running for session in self._sessions)

    @property
    def in_flight_calls(self) -> int:
        """How many calls are in flight or being saved, as the workers told last."""
        return sum(session.in_flight_calls for session in self._sessions)

    @property
    def waits(self) -> Sequence[Wait]:
        """What the other calls wait for, as the workers told last."""
        return [wait for session in self._sessions for wait in session.waits]

    def answers(self, name: str) -> int:
        """How many calls of this run a model has answered."""
        return self.answered[self._plan.entries[name].id]

    async def play(self, specs: Iterable[TrialSpec], ended: Ended, room: Room = no_wait) -> None:
        """See TrialRunner."""
        self._ended = ended
        self._room = room
        self._waiting.extend(specs)
        self._unfinished = {spec.order for spec in self._waiting}
        while self._unfinished:
            await self._count_workers()
            for _ in range(min(self._slots - len(self._batches), len(self._waiting))):
                self._submit()
            done, _ = await asyncio.wait(
                [self._failure, *self._batches],
                timeout=LOOK_EVERY_S,
                return_when=asyncio.FIRST_COMPLETED,
            )
            for batch in done:
                self._batches.pop(batch, None)  # type: ignore[call-overload] # the failure is none
                batch.result()

    async def drain(self) -> None:
        """See TrialRunner."""
        self._stopping = True
        self._waiting.clear()
        for session in self._sessions:
            session.link.tell("stop")
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(GOODBYE_S):
                await self._client.cancel(list(self._batches.values()))
        for batch in self._batches:
            batch.cancel()
        await asyncio.gather(*self._sessions.values(), return_exceptions=True)

    def fail(self, error: BaseException) -> None:
        """End the run with this error, unless another one was first."""
        if not self._failure.done():
            self._failure.set_exception(error)

    def ended(self, spec: TrialSpec, record: TrialRecord | TrialSuspended) -> None:
        """A trial has ended at a worker."""
        self._unfinished.remove(spec.order)
        assert self._ended is not None
        try:
            self._ended(spec, record)
        except MergeRunnerError as exc:
            self.fail(exc)

    async def admit(self, session: Session, token: str, theirs: str, host: str) -> Batch | None:
        """The batch for a worker that joins; None if there is nothing to do."""
        if not secrets.compare_digest(token, self._token):
            session.link.abort()
            return None
        if theirs != fingerprint():
            raise UsageError(
                f"a Dask worker on {host} has merge-runner {theirs}, and this is {fingerprint()}: "
                "install the same one for all, with the same plug-ins"
            )
        self._refuse_unreachable_emulator(host)
        await self._room()
        # All --in-flight trials may be given out; the next worker waits until a batch has ended.
        while not self._free and self._waiting:
            self._freed.clear()
            await self._freed.wait()
        if self._stopping or not self._waiting:
            return None
        slots = max(1, min(self._slots, self._in_flight))
        share = min(self._free, max(1, self._in_flight // slots))
        idle = max(1, slots - sum(bool(other.trials) for other in self._sessions))
        # Large batches at first, to save messages, and smaller ones toward the end, so that no
        # worker still has many when the others have none; never fewer than it plays at once.
        size = min(
            math.ceil(len(self._waiting) / idle),
            max(share, math.ceil(len(self._waiting) / (BATCHES_PER_WORKER * slots))),
        )
        specs = [self._waiting.popleft() for _ in range(size)]
        session.trials = {spec.order: spec for spec in specs}
        session.in_flight = min(share, size)
        self._free -= session.in_flight
        return Batch(
            specs=tuple(specs),
            in_flight=session.in_flight,
            plan=self._plan,
            endpoint_plan=replace(self._endpoint_plan, passed=self._passed()),
        )

    def _passed(self) -> frozenset[str]:
        """The models that have answered in this run: no worker needs to try them alone."""
        return frozenset(name for name in self._plan.entries if self.answers(name))

    async def _serve(self, comm: Comm) -> None:
        """Serve a worker's batch from its first message until the worker is gone."""
        session = Session(self, comm)
        serving = self._sessions[session] = asyncio.create_task(session.serve())
        await asyncio.wait([serving])
        del self._sessions[session]
        self._free += session.in_flight
        self._freed.set()
        error = None if serving.cancelled() else serving.exception()
        if error is not None:
            self.fail(error)  # a fault of ours: the run raises it
        if self._stopping:
            return
        # Trials it had not ended go to the front, in order. Whichever worker plays them next finds
        # their replies in the cache.
        rest = sorted(session.trials.values(), key=lambda spec: spec.order)
        self._waiting.extendleft(reversed(rest))
        if rest and not session.ended:
            self._note(f"the worker {session.worker} is lost: its {len(rest)} trials go to others")

    def _note(self, line: str) -> None:
        next(iter(self.meters.values())).notes.append(line)

    async def _count_workers(self) -> None:
        try:
            threads = await self._client.nthreads()
        except OSError as exc:
            raise ClusterFailed(SCHEDULER_GONE) from exc
        self.workers = len(threads)
        self._slots = sum(threads.values())

    def _submit(self) -> None:
        future = self._client.submit(
            play_batch, self._listener.contact_address, self._token, pure=False
        )
        self._batches[asyncio.create_task(_finished(future))] = future

    def _refuse_unreachable_emulator(self, host: str) -> None:
        url = self._endpoint_plan.urls.get("EMULATOR_BASE_URL", "")
        if "//127.0.0.1:" in url and host != socket.gethostname():
            raise UsageError(
                f"the emulator listens on this machine alone, and a Dask worker is on {host}: play "
                "the emulator with --dask local:N"
            )


async def _finished(batch: Future) -> None:
    """Wait for a Dask task; raises what a user can act on."""
    error: BaseException | None = await batch.exception()
    if batch.status not in ("finished", "error"):
        raise ClusterFailed(SCHEDULER_GONE)
    if isinstance(error, KilledWorker):
        raise ClusterFailed(
            f"one batch was begun on several Dask workers, and all died: {error}. Look at their "
            "memory and their logs; run the same command again to go on"
        )
    if isinstance(error, ImportError):
        raise UsageError(
            f"a Dask worker cannot load merge-runner ({error}): install the same one for all"
        )
    if error is not None:
        raise error
