"""Two sweeps at once on the same cache and database: no call is made twice, no row is lost."""

from __future__ import annotations

import asyncio
import json
import os
import signal
import sys

import pytest

from merge_runner.emulator.faults import FaultPlan
from merge_runner.llm.claims import Claims
from merge_runner.results.store import results_digest
from tests.harness import watched

pytestmark = pytest.mark.long

SWEEP = ("sweep", "baseline", "--reps", 1, "--json")
TAKE = """
import sys, time
from pathlib import Path
from merge_runner.llm.claims import Claims
claims = Claims(Path(sys.argv[1]))
print(claims.take(sys.argv[2]), flush=True)
time.sleep(60)
"""


async def test_two_sweeps_share_every_call_and_lose_no_row(merge_runner, tmp_path, quiet):
    async with watched(faults=FaultPlan(latency_s=0.05)) as server:
        env = {"EMULATOR_BASE_URL": f"{server.url}/v1"}
        # The same trials in another order, so that each waits for the other now and then.
        orders = [("--order-seed", seed, "--in-flight", 4) for seed in (1, 2)]
        runs = await asyncio.gather(*(merge_runner(*SWEEP, *order, **env) for order in orders))
        assert set(server.asked.values()) == {1}
    assert [run.code for run in runs] == [0, 0], [run.err for run in runs]
    assert sum(run.summary["calls"]["live"] for run in runs) == server.requests
    assert all(run.summary["calls"]["live"] > 0 for run in runs)
    assert all(run.summary["trials"]["planned"] == 11 for run in runs)
    counted = await merge_runner(
        "sql",
        "select count(*) as rows, count(distinct (trial_id, side, decision, attempt)) as calls, "
        "(select count(*) from trials) as trials, "
        "(select count(*) from sweep_trials) as linked from calls",
        "--format", "json",
    )  # fmt: skip
    assert json.loads(counted.out) == [
        {"rows": server.requests, "calls": server.requests, "trials": 11, "linked": 22}
    ]
    assert results_digest(tmp_path / "results/merge.duckdb") == quiet


async def test_a_claim_is_free_when_its_holder_dies(tmp_path):
    key, other = "a" * 64, "b" * 64
    holder = await asyncio.create_subprocess_exec(
        sys.executable, "-c", TAKE, tmp_path, key, stdout=asyncio.subprocess.PIPE
    )
    assert await holder.stdout.readline() == b"True\n"
    claims = Claims(tmp_path)
    assert not claims.take(key)
    assert claims.take(other)
    os.kill(holder.pid, signal.SIGKILL)
    await holder.wait()
    assert claims.take(key)
    claims.close()


async def test_a_sweep_goes_on_with_the_calls_of_one_that_died_beside_it(merge_runner):
    async def middle(request, handler):
        if not released.is_set():
            held.set()
            await released.wait()
        return await handler(request)

    held, released = asyncio.Event(), asyncio.Event()
    sweep = (*SWEEP, "--conditions", "L_4_8")
    async with watched(middle) as server:
        env = {"EMULATOR_BASE_URL": f"{server.url}/v1"}
        first = await merge_runner.fork(*sweep, **env)
        await held.wait()
        second = asyncio.create_task(merge_runner(*sweep, **env))
        await asyncio.sleep(2)
        assert set(server.asked.values()) == {1}, "the second one waits for the first one's calls"
        first.kill()
        await first.wait()
        released.set()
        run = await second
    assert run.code == 0, run.err
    assert run.summary["trials"]["finished"] == 1
