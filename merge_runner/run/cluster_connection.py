"""Connects to a Dask cluster, or starts a local one."""

from __future__ import annotations

import logging
import os
import re
import signal
from collections.abc import AsyncIterator, Mapping
from contextlib import AsyncExitStack, asynccontextmanager
from multiprocessing import resource_tracker
from pathlib import Path
from typing import TYPE_CHECKING

from merge_runner.errors import UsageError

if TYPE_CHECKING:
    from distributed import Client

CONNECT_TIMEOUT_S = 10
_WHERE = re.compile(
    r"local:(?P<workers>[1-9]\d*)|(?P<file>.+\.json)|((tcp|tls)://)?(?!local:)[^\s/]+:[1-9]\d*",
    re.ASCII,
)
VALID = (
    "valid: local:N (N workers on this machine), a scheduler's tcp://HOST:PORT or tls://HOST:PORT, "
    "or its file PATH.json"
)
# Loggers with a level of their own. Dask and its libraries log tracebacks of errors that a run
# reports in one line, such as lost workers.
LOGGERS = ("distributed", "distributed.client", "tornado", "tornado.application")


def _restore_environment(before: Mapping[str, str]) -> None:
    for name in {*os.environ} - {*before}:
        del os.environ[name]
    os.environ.update(before)


@asynccontextmanager
async def connected(where: str) -> AsyncIterator[Client]:
    """Connect to the cluster that ``--dask`` names, or start a local one; raises UsageError."""
    match = _WHERE.fullmatch(where)
    is_file = Path(where).is_file()  # noqa: ASYNC240 # nothing else runs yet
    if match is None or (match["file"] and not is_file):
        raise UsageError(f"--dask {where!r} names no cluster; {VALID}")
    try:
        import distributed
    except ModuleNotFoundError as exc:
        raise UsageError(
            "--dask needs the package distributed: pip install 'merge-runner[dask]'"
        ) from exc

    async with AsyncExitStack() as stack:
        for logger in map(logging.getLogger, LOGGERS):
            stack.callback(logger.setLevel, logger.level)
            logger.setLevel(logging.CRITICAL + 1)
        scheduler = {"scheduler_file" if match["file"] else "address": where}
        if match["workers"]:
            stack.callback(_restore_environment, {**os.environ})  # Dask sets some for its children
            os.environ["PYTHONSAFEPATH"] = "1"  # workers import nothing of this folder
            # A terminal's Ctrl-C reaches this process alone, which stops them in order: children
            # inherit what is blocked. The tracker, if it were started meanwhile, would unblock it.
            resource_tracker.ensure_running()
            before = signal.pthread_sigmask(signal.SIG_BLOCK, (signal.SIGINT, signal.SIGHUP))
            try:
                local = distributed.LocalCluster(
                    n_workers=int(match["workers"]),
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
        if match["workers"]:  # the first of them would get the share of all
            await client.wait_for_workers(int(match["workers"]))
        yield client
