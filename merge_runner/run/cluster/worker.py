"""A Dask task: a batch of trials, played by the same code as in one process."""

from __future__ import annotations

import asyncio
import contextlib
import signal
import socket
import threading
from contextlib import AsyncExitStack
from functools import partial

from distributed import Worker, get_worker
from distributed.comm import connect

from merge_runner.errors import MergeRunnerError, TrialSuspended
from merge_runner.llm.meter import Meter
from merge_runner.records import TrialRecord, TrialSpec
from merge_runner.registry import in_use, use
from merge_runner.run.clients import live_clients
from merge_runner.run.cluster.batch import Batch, fingerprint
from merge_runner.run.cluster.link import Link, LinkLost, taken_apart
from merge_runner.run.cluster.remote import RemoteBudget, RemoteCache, RemoteRateLimit
from merge_runner.run.local_runner import LocalRunner
from merge_runner.signals import FROM_TERMINAL
from merge_runner.study.file import StudySource
from merge_runner.study.parts import catalogue_of

REPORT_EVERY_S = 0.5
_making_catalogue = threading.Lock()


def dask_setup(_: object) -> None:
    """Called by Dask where this is a worker's preload: signals are for the coordinator alone."""
    for number in FROM_TERMINAL:
        signal.signal(number, signal.SIG_IGN)


def play_batch(address: str, token: str) -> None:
    """Ask the coordinator for a batch and play it; errors of ours go back over the link."""
    asyncio.run(_Worker().play(address, token))


class _Worker:
    """One batch at a worker, from its first message to its last."""

    def __init__(self) -> None:
        self._work: asyncio.Task[None] | None = None
        self._stopping = False

    async def play(self, address: str, token: str) -> None:
        dask = get_worker()
        _stop_profiler(dask)
        try:
            comm = await connect(address, **dask.security.get_connection_args("worker"))
        except OSError:
            return  # the coordinator is gone, and nobody would read an error
        link = Link(comm, {"stop": self._stop})
        serving = asyncio.create_task(link.serve())
        serving.add_done_callback(lambda _: self._stop())
        error: MergeRunnerError | None = None
        try:
            batch: Batch | None = await link.ask(
                "join", token, fingerprint(), dask.address, socket.gethostname()
            )
            if batch is None:
                return
            with contextlib.suppress(asyncio.CancelledError):
                await self._play(batch, link)
        except MergeRunnerError as exc:
            error = exc
        finally:
            with contextlib.suppress(LinkLost):
                await link.ask("end", error and taken_apart(error))
            await link.close()
            await serving

    async def _play(self, batch: Batch, link: Link) -> None:
        entries = batch.plan.entries
        use_study(batch.plan.study)
        async with AsyncExitStack() as stack:
            clients = live_clients(
                batch.plan,
                batch.endpoint_plan,
                RemoteCache(link),
                {name: RemoteRateLimit(link, name) for name in entries},
                RemoteBudget(link),
                connections=2 * batch.in_flight,
                stack=stack,
            )
            runner = LocalRunner(batch.plan, clients, batch.in_flight)
            self._work = asyncio.create_task(runner.play(batch.specs, partial(_tell, link)))
            if self._stopping:  # told to stop before there was anything to cancel
                self._work.cancel()
            reporting = asyncio.create_task(_report(runner, link))
            try:
                await asyncio.wait([self._work])
                await runner.drain()
            finally:
                reporting.cancel()
                _tell_progress(runner, link)
            self._work.result()

    def _stop(self) -> None:
        self._stopping = True
        if self._work is not None:
            self._work.cancel()


def use_study(study: StudySource) -> None:
    """Use a study's catalogue; the one that other threads play by stays where it is the same."""
    with _making_catalogue:
        if (in_use().text, in_use().plugins) != (study.text, study.plugins):
            use(catalogue_of(study.file, study.text, study.plugins))


def _stop_profiler(dask: Worker) -> None:
    """Stop Dask's profiler, which samples all threads a hundred times a second."""
    # Python 3.11 can deadlock there when it collects a threading.local.
    if (profiler := dask.periodic_callbacks.get("profile")) is not None:
        dask.loop.add_callback(profiler.stop)


def _tell(link: Link, spec: TrialSpec, record: TrialRecord | TrialSuspended) -> None:
    told = str(record) if isinstance(record, TrialSuspended) else record
    link.tell("trial", spec.order, told)


async def _report(runner: LocalRunner, link: Link) -> None:
    while True:
        _tell_progress(runner, link)
        await asyncio.sleep(REPORT_EVERY_S)


def _tell_progress(runner: LocalRunner, link: Link) -> None:
    """What was counted since the last time, and what is under way now."""
    since = {}
    for name, client in runner.clients.items():
        since[name], client.meter = client.meter, Meter()
    link.tell("report", since, runner.running, runner.in_flight_calls, runner.waits)
