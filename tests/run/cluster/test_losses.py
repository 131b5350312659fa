"""A worker or the coordinator dies, stands still, or is interrupted in the midst of a batch."""

from __future__ import annotations

import asyncio
import json

import psutil
import pytest

from merge_runner.signals import FROM_TERMINAL
from tests.gate import HANGS_S, Gate
from tests.harness import watched
from tests.run.cluster.workers import SWEEP, held_from, workers_of

pytestmark = pytest.mark.slow

ON_THREE = (*SWEEP, "--dask", "local:3")
ON_TWO = (*SWEEP, "--dask", "local:2")


async def ended(process) -> tuple[int, str, str]:
    """How a sweep ended, of which no process may be left."""
    family = psutil.Process(process.pid).children(recursive=True)
    async with asyncio.timeout(HANGS_S):
        out, err = await process.communicate()
    _, alive = psutil.wait_procs(family, timeout=HANGS_S)
    assert not alive
    return process.returncode, out.decode(), err.decode()


async def test_a_worker_that_is_killed_costs_its_calls_in_flight_and_nothing_else(
    merge_runner, started, quiet_digest, tmp_path
):
    gate = Gate(40)
    async with watched(gate.middle) as server:
        process = await started(*ON_THREE, EMULATOR_BASE_URL=f"{server.url}/v1")
        await gate.quiet(tmp_path / "cache/responses", trials=4)
        victim = next(w for w in workers_of(process.pid) if held_from(gate, w))
        lost = held_from(gate, victim)
        victim.kill()
        await process.said("is lost: its ")
        gate.open()
        code, out, err = await ended(process)
    assert code == 0, err
    assert gate.asked_again == lost
    assert "is lost: its " in err
    assert json.loads(out)["trials"]["finished"] + json.loads(out)["trials"]["collided"] == 6
    assert (await merge_runner("digest")).out == quiet_digest


@pytest.mark.long
async def test_a_worker_that_stands_still_holds_up_its_own_trials_alone(
    merge_runner, started, quiet_digest, tmp_path
):
    gate = Gate(40)
    async with watched(gate.middle) as server:
        process = await started(*ON_THREE, "--in-flight", 3, EMULATOR_BASE_URL=f"{server.url}/v1")
        await gate.quiet(tmp_path / "cache/responses", trials=3)
        still = next(w for w in workers_of(process.pid) if held_from(gate, w))
        own = held_from(gate, still)
        still.suspend()
        gate.open()
        # Each worker has one trial of 19 calls at a time; all others of the 114 calls are made.
        async with asyncio.timeout(HANGS_S):
            while len(gate.asked) < 95:
                await asyncio.sleep(0.1)
        still.resume()
        code, _, err = await ended(process)
    assert own
    assert code == 0, err
    assert not gate.asked_again
    assert (await merge_runner("digest")).out == quiet_digest


@pytest.mark.long
async def test_a_coordinator_that_is_killed_loses_the_calls_in_flight(
    merge_runner, started, quiet_digest, tmp_path
):
    gate = Gate(40)
    async with watched(gate.middle) as server:
        env = {"EMULATOR_BASE_URL": f"{server.url}/v1"}
        process = await started(*ON_TWO, **env)
        await gate.quiet(tmp_path / "cache/responses", trials=4)
        workers = workers_of(process.pid)
        family = psutil.Process(process.pid).children(recursive=True)
        lost = set(gate.held)
        process.kill()
        await process.wait()
        _, alive = psutil.wait_procs(family, timeout=HANGS_S)
        assert (len(workers), alive) == (2, [])
        gate.open()
        run = await merge_runner(*SWEEP, **env)
    assert run.code == 0, run.err
    assert gate.asked_again <= lost
    assert run.summary["calls"]["live"] <= 114 - 40 + len(lost)
    assert (await merge_runner("digest")).out == quiet_digest


@pytest.mark.long
@pytest.mark.parametrize("number", FROM_TERMINAL)
async def test_ctrl_c_saves_what_the_workers_have_in_flight(
    merge_runner, started, tmp_path, number
):
    gate = Gate(40)
    async with watched(gate.middle) as server:
        env = {"EMULATOR_BASE_URL": f"{server.url}/v1"}
        process = await started(*ON_TWO, **env)
        await gate.quiet(tmp_path / "cache/responses", trials=4)
        process.send_signal(number)
        for worker in workers_of(process.pid):
            worker.send_signal(number)  # as a terminal does
        await process.said("are saved first")
        gate.open()
        code, _, err = await ended(process)
        assert code == 130, err
        assert f"{len(gate.held)} calls in flight are saved first" in err
        assert "Traceback" not in err
        run = await merge_runner(*SWEEP, **env)
    assert run.code == 0, run.err
    assert not gate.asked_again
    assert len(set(gate.asked)) == 114
