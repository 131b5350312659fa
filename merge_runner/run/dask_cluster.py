"""The cluster that ``--dask`` names: workers on this machine, or an existing scheduler."""

from __future__ import annotations

import logging
import multiprocessing
import os
import re
import signal
import sys
from collections.abc import AsyncIterator, Iterator
from contextlib import asynccontextmanager, contextmanager
from multiprocessing import resource_tracker
from pathlib import Path
from typing import TYPE_CHECKING

from merge_runner.errors import UsageError

if TYPE_CHECKING:
    from distributed import Client

CONNECT_TIMEOUT_S = 10
# What a worker imports, and a process from which all are forked imports once.
SHARED = ["distributed", "merge_runner.run.dask_tasks", "merge_runner.llm.http"]
_WHERE = re.compile(
    r"local:(?P<workers>[1-9]\d*)|(?P<file>.+\.json)"
    r"|((tcp|tls)://)?(?!local:)(\[[\da-fA-F:.]+\]|[^\s/:]+):[1-9]\d*",
    re.ASCII,
)
VALID = (
    "valid: local:N (N workers on this machine), the address of a scheduler "
    "(tcp://HOST:PORT, tls://HOST:PORT), or its scheduler file (PATH.json)"
)


@asynccontextmanager
async def connected(where: str) -> AsyncIterator[Client]:
    """Connect to the cluster, or start it where it is local; raises UsageError."""
    workers, to = _parsed(where)
    try:
        import distributed
    except ModuleNotFoundError as exc:
        raise UsageError("--dask needs the package distributed: pip install distributed") from exc

    _silence()
    if workers:
        async with (
            _local_cluster(workers) as cluster,
            distributed.Client(cluster, asynchronous=True) as client,
        ):
            yield client
        return
    try:
        client = await distributed.Client(**to, asynchronous=True, timeout=CONNECT_TIMEOUT_S)
    except (OSError, ValueError) as exc:
        raise UsageError(
            f"no Dask scheduler answers at {where} within {CONNECT_TIMEOUT_S} s; start one with "
            f"`dask scheduler`, or leave the address out: {VALID}"
        ) from exc
    try:
        yield client
    finally:
        await client.close(timeout=CONNECT_TIMEOUT_S)


@asynccontextmanager
async def _local_cluster(workers: int) -> AsyncIterator[object]:
    """Worker processes; Ctrl-C reaches this process alone, which stops them in order."""
    import dask
    from distributed import LocalCluster

    _choose_how_workers_start()
    settings = {
        # None leaves the method chosen above: given "forkserver", it has it import pandas.
        "distributed.worker.multiprocessing-method": None,
        "distributed.admin.large-graph-warning-threshold": "1GB",
    }
    with dask.config.set(settings):
        cluster = LocalCluster(
            n_workers=workers,
            threads_per_worker=1,
            processes=True,
            dashboard_address=None,
            silence_logs=logging.CRITICAL,
            asynchronous=True,
        )
        with _for_children():
            await cluster
        async with cluster:
            yield cluster


def _choose_how_workers_start() -> None:
    """On Linux, where it is safe, fork them from a process that has their imports; else spawn."""
    method = "forkserver" if sys.platform == "linux" else "spawn"
    multiprocessing.set_start_method(method, force=True)
    if method == "forkserver":
        multiprocessing.set_forkserver_preload(SHARED)


@contextmanager
def _for_children() -> Iterator[None]:
    """Processes started here ignore the terminal's signals, and import nothing of this folder."""
    resource_tracker.ensure_running()  # starting it in the block would unblock Ctrl-C again
    name = "PYTHONSAFEPATH"
    kept = os.environ.get(name)
    os.environ[name] = "1"
    before = signal.pthread_sigmask(
        signal.SIG_BLOCK, (signal.SIGINT, signal.SIGHUP)
    )  # children inherit it
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
        del os.environ[name]
        if kept is not None:
            os.environ[name] = kept


def _silence() -> None:
    """Silence Dask, which logs tracebacks for what we report in a line, such as lost workers."""
    for name in logging.root.manager.loggerDict:
        if name.partition(".")[0] == "distributed":
            logging.getLogger(name).setLevel(logging.CRITICAL)


def _parsed(where: str) -> tuple[int, dict[str, str]]:
    """The number of workers to start, or 0 and what finds the scheduler."""
    named = _WHERE.fullmatch(where)
    if named is None:
        raise UsageError(f"--dask {where!r} names no cluster; {VALID}")
    if (file := named["file"]) is None:
        return int(named["workers"] or 0), {
            "address": where if "://" in where else f"tcp://{where}"
        }
    if not Path(file).is_file():
        raise UsageError(f"there is no scheduler file {file}; {VALID}")
    return 0, {"scheduler_file": file}
