"""The cluster that ``--dask`` names: workers on this machine, or an existing scheduler."""

from __future__ import annotations

import logging
import signal
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path
from typing import TYPE_CHECKING
from urllib.parse import urlsplit

from merge_runner.errors import UsageError

if TYPE_CHECKING:
    from distributed import Client

CONNECT_TIMEOUT_S = 10
SCHEMES = ("tcp", "tls")
VALID = (
    "valid: local:N (N workers on this machine), the address of a scheduler "
    "(tcp://HOST:PORT, tls://HOST:PORT), or its scheduler file (PATH.json)"
)


@asynccontextmanager
async def connected(where: str) -> AsyncIterator[Client]:
    """Connect to the cluster, or start it where it is local; raises UsageError."""
    try:
        import distributed
    except ModuleNotFoundError as exc:
        raise UsageError(
            "--dask needs the package distributed: pip install 'merge-runner[dask]'"
        ) from exc

    _silence()
    kind, _, rest = where.partition(":")
    if kind == "local":
        if not (rest.isascii() and rest.isdigit() and int(rest) > 0):
            raise _unknown(where)
        async with (
            _local_cluster(int(rest)) as cluster,
            distributed.Client(cluster, asynchronous=True) as client,
        ):
            yield client
        return
    to = {"scheduler_file": where} if _is_scheduler_file(where) else {"address": _address(where)}
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
    """Worker processes; Ctrl-C is for us alone, who stop them in order."""
    from distributed import LocalCluster

    cluster = LocalCluster(
        n_workers=workers,
        threads_per_worker=1,
        processes=True,
        dashboard_address=None,
        silence_logs=logging.CRITICAL,
        preload=["merge_runner.cluster.worker"],  # also for one that takes a lost one's place
        asynchronous=True,
    )
    before = signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGINT])  # children inherit it
    try:
        await cluster
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
    async with cluster:
        yield cluster


def _silence() -> None:
    """Dask logs with tracebacks what we tell in a line: lost workers, a lost scheduler."""
    for name in logging.root.manager.loggerDict:
        if name.partition(".")[0] == "distributed":
            logging.getLogger(name).setLevel(logging.CRITICAL)


def _is_scheduler_file(where: str) -> bool:
    if not where.endswith(".json"):
        return False
    if not Path(where).is_file():
        raise UsageError(f"there is no scheduler file {where}; {VALID}")
    return True


def _address(where: str) -> str:
    try:
        parts = urlsplit(where if "://" in where else f"tcp://{where}")
        usable = parts.scheme in SCHEMES and parts.hostname and parts.port and not parts.path
    except ValueError:
        usable = False
    if not usable:
        raise _unknown(where)
    return parts.geturl()


def _unknown(where: str) -> UsageError:
    return UsageError(f"--dask {where!r} names no cluster; {VALID}")
