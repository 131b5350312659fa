"""Clusters of Dask that tests start, watch and kill."""

import asyncio
import json
import sys

import psutil
import pytest

from merge_runner.records import SIDES
from tests.support import program
from tests.support.gate import HANGS_S, Gate
from tests.support.harness import environment

SMALL = ("sweep", "baseline", "--reps", 1, "--conditions", "L_4_0", "--json")
# Six trials of 19 calls each.
SIX = ("sweep", "baseline", "--reps", 2, "--conditions", "L_4_0,N_0_0,R_-4_8", "--json")


@pytest.fixture
def started(tmp_path):
    """Starts a sweep on a cluster; what is left of it is killed in the end."""
    families: list[psutil.Process] = []

    async def start(*arguments, **env):
        process = await program.start(arguments, cwd=tmp_path, env=environment(**env))
        families.append(psutil.Process(process.pid))
        return process

    yield start
    for parent in families:
        if parent.is_running():
            for process in (*parent.children(recursive=True), parent):
                process.kill()


def workers_of(pid: int) -> list[psutil.Process]:
    """The workers that a coordinator has started."""
    children = psutil.Process(pid).children()
    return [child for child in children if "spawn_main" in " ".join(child.cmdline())]


def held_from(gate: Gate, worker: psutil.Process) -> set[str]:
    """The slots that wait for an answer on a worker's connections."""
    ports = {c.laddr.port for c in worker.net_connections("tcp")}
    return {slot for slot, port in gate.held.items() if port in ports}


def repetition_of(slot: str) -> tuple[str, int]:
    told = json.loads(slot)
    return told["condition"], told["repetition"]


async def all_held(gate: Gate, trials: int) -> None:
    """Wait until both drivers of so many trials are held."""
    async with asyncio.timeout(HANGS_S):
        while len(gate.held) < len(SIDES) * trials:
            await asyncio.sleep(0.05)


async def ended(process) -> tuple[int, str, str]:
    """How a sweep ended, of which no process may be left."""
    family = psutil.Process(process.pid).children(recursive=True)
    async with asyncio.timeout(HANGS_S):
        out, err = await process.communicate()
    _, alive = psutil.wait_procs(family, timeout=HANGS_S)
    assert not alive
    return process.returncode, out.decode(), err.decode()


@pytest.fixture
async def scheduler(tmp_path):
    """A scheduler of its own; called, it adds a worker."""
    file = tmp_path / "scheduler.json"
    to = ("--scheduler-file", file, "--no-dashboard")
    processes = []

    async def start(*arguments, **changes):
        process = await asyncio.create_subprocess_exec(
            sys.executable, "-m", "distributed.cli.dask_worker", *arguments, *map(str, to),
            cwd=tmp_path, env=environment(**changes),
            stdout=asyncio.subprocess.DEVNULL, stderr=asyncio.subprocess.DEVNULL,
        )  # fmt: skip
        processes.append(psutil.Process(process.pid))

    start.process = await program.start(
        ("--port", "0", "--host", "127.0.0.1", *to),
        cwd=tmp_path, env=environment(), module="distributed.cli.dask_scheduler",
    )  # fmt: skip
    processes.append(psutil.Process(start.process.pid))
    while not file.exists():
        await asyncio.sleep(0.1)
    start.file = file
    yield start
    for parent in filter(psutil.Process.is_running, processes):
        for process in (*parent.children(recursive=True), parent):
            process.kill()
