"""The account's limits, pauses and the cost cap hold over all workers, as the server sees it."""

from __future__ import annotations

import asyncio
import json
import shutil
import signal
import time

import pytest
from aiohttp import web

from tests.harness import FAST, PROJECT, watched
from tests.llm.test_limiter import fullest_window

pytestmark = pytest.mark.long

SWEEP = ("sweep", "baseline", "--reps", 1, "--json")
ON_THREE = ("--dask", "local:3")
THREE = ("--conditions", "L_4_0,N_0_0,R_-4_8")


class Clock:
    """When requests came, and the tokens of their answers."""

    def __init__(self):
        self.times = []
        self.tokens = []
        self.ports = set()

    async def middle(self, request, handler):
        self.times.append(time.monotonic())
        self.ports.add(request.transport.get_extra_info("peername")[1])
        reply = await handler(request)
        usage = json.loads(reply.body)["usage"]
        self.tokens.append(usage["prompt_tokens"] + usage["completion_tokens"])
        return reply


async def test_requests_a_minute_hold_over_all_workers(merge_runner):
    clock = Clock()
    async with watched(clock.middle) as server:
        url = f"{server.url}/v1"
        run = await merge_runner(*SWEEP, *ON_THREE, *THREE, "--rpm", 600, EMULATOR_BASE_URL=url)
    assert run.code == 0, run.err
    assert len(clock.times) == run.summary["calls"]["live"] > 50
    # Half a second's worth goes at a time, and may come a little late; one limiter for each worker
    # would let three times as many through.
    assert fullest_window(clock.times, [1] * len(clock.times), length=1.0) <= 1.5 * 10 + 1
    assert clock.times[-1] - clock.times[0] >= (len(clock.times) - 10) / 10


async def test_tokens_a_minute_hold_over_all_workers_and_waiting_calls_can_be_given_up(
    merge_runner, started
):
    limit = 60_000
    clock = Clock()
    async with watched(clock.middle) as server:
        env = {"EMULATOR_BASE_URL": f"{server.url}/v1"}
        process = await started(*SWEEP, *ON_THREE, "--tpm", limit, **env)
        while len(clock.times) < 40:
            await asyncio.sleep(0.1)
        await asyncio.sleep(3)
        process.send_signal(signal.SIGINT)
        out, err = await process.communicate()
    assert process.returncode == 130, err
    assert limit / 2 < sum(clock.tokens) <= limit
    assert "Stopping: 0 calls in flight" in err.decode()
    assert json.loads(out)["calls"]["live"] == len(clock.times)


async def test_where_one_worker_is_asked_to_wait_all_wait(merge_runner):
    clock = Clock()
    asked = []

    async def middle(request, handler):
        if len(clock.times) == 20 and not asked:
            asked.append(time.monotonic())
            raise web.HTTPTooManyRequests(headers={"retry-after": "3"}, text="{}")
        return await clock.middle(request, handler)

    async with watched(middle) as server:
        url = f"{server.url}/v1"
        run = await merge_runner(*SWEEP, *ON_THREE, *THREE, "--reps", 2, EMULATOR_BASE_URL=url)
    assert run.code == 0, run.err
    assert run.summary["attempts"] == {"ok": len(clock.times), "rate_limited": 1}
    # Each driver of the six trials may have had its turn already; together they ask far more.
    assert len([t for t in clock.times if asked[0] < t < asked[0] + 2.9]) <= 12
    assert "all its calls wait 3.0 s" in run.err


async def test_the_cost_cap_holds_over_all_workers_and_a_higher_one_goes_on(merge_runner, tmp_path):
    # Trials end after 12 s at the latest, so that none can cost more than 3.4 USD.
    shutil.copytree(PROJECT / "experiments", tmp_path / "experiments")
    short = "[repetitions]\nbaseline = 10\n[scenario]\ntimeout_s = 12\n"
    (tmp_path / "experiments/baseline.toml").write_text(short)
    cap, usd = 3.7, 0.0

    async def middle(request, handler):
        nonlocal usd
        reply = await handler(request)
        usage = json.loads(reply.body)["usage"]
        usd += (2 * usage["prompt_tokens"] + 8 * usage["completion_tokens"]) / 1e6
        return reply

    async with watched(middle) as server:
        env = {"OPENAI_API_KEY": "a-dummy-key", "OPENAI_BASE_URL": f"{server.url}/v1"}
        sweep = (*SWEEP, *THREE, "--reps", 18, "--model", "o3", "--yes", *FAST)
        run = await merge_runner(*sweep, *ON_THREE, "--max-cost", cap, **env)
        assert run.code == 3, run.err
        assert 0 < usd <= cap
        assert run.summary["cost_usd"] == pytest.approx(usd)
        assert run.summary["sweep_cost_usd"] == pytest.approx(usd)
        assert run.summary["trials"]["suspended"] > 0
        done = await merge_runner(*sweep, "--max-cost", 50, **env)
        assert done.code == 0, done.err
        calls = await merge_runner("sql", "select count(*) from calls", "--format", "csv")
        assert int(calls.out.split()[1]) == server.requests, "nothing was paid for twice"
    assert done.summary["sweep_cost_usd"] == pytest.approx(usd)
    assert done.summary["set_aside_usd"] == 0
