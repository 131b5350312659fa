"""What takes long on a Dask cluster: who is gone or stands still, and the limits of all workers."""

import asyncio
import json
import math
import shutil
import signal
import time

import pytest
from aiohttp import web

from tests.support.cluster import SIX, SMALL, all_held, ended, held_from, workers_of
from tests.support.gate import HANGS_S, Gate
from tests.support.harness import FAST, PROJECT, watched
from tests.support.mock_server import FaultPlan


async def test_where_no_scheduler_listens_and_where_no_model_answers_it_says_so_soon(
    merge_runner, emulator_url
):
    run = await merge_runner(*SMALL, "--dask", "127.0.0.1:1")
    assert (run.code, len(run.err.splitlines())) == (2, 1)
    assert run.err.startswith("error: no Dask scheduler answers at 127.0.0.1:1 within 10 s")
    o3 = (*SMALL, "--model", "o3", "--yes", *FAST, "--dask", "local:1")
    dead = await merge_runner(*o3, OPENAI_API_KEY="x", OPENAI_BASE_URL="http://127.0.0.1:9/v1")
    assert (dead.code, dead.summary["trials"]["failed"]) == (1, 0)
    run = await merge_runner(*o3, OPENAI_API_KEY="x", OPENAI_BASE_URL=emulator_url)
    assert (run.code, run.summary["scripted"]) == (0, True), run.err
    async with watched(faults=FaultPlan(rates={"malformed": 1.0})) as server:
        part = ("sweep", "baseline", "--reps", 4, "--in-flight", 2, "--dask", "local:1", "--json")
        stopped = await merge_runner(*part, **server.env)
    assert (stopped.code, server.requests < 100) == (1, True), "it asked all"
    assert "decisions of emulator is valid" in stopped.summary["messages"][0]


async def test_a_scheduler_that_dies_ends_the_run_in_one_line(merge_runner, scheduler):
    async def middle(request, handler):
        if server.requests == 10:
            scheduler.process.kill()
        return await handler(request)

    await scheduler("--no-nanny")
    async with watched(middle, FaultPlan(latency_s=0.2)) as server:
        url = f"{server.url}/v1"
        run = await merge_runner(*SMALL, "--dask", scheduler.file, EMULATOR_BASE_URL=url, code=1)
        assert "error: the Dask scheduler is gone" in run.err
        assert "Traceback" not in run.err
        again = await merge_runner(*SMALL, EMULATOR_BASE_URL=url)
    assert again.code == 0, again.err
    assert sum(server.asked.values()) <= len(server.asked) + 2, "an answered call is made again"


async def test_a_worker_that_stands_still_holds_up_its_own_trials_alone(
    merge_runner, started, tmp_path
):
    gate = Gate(math.inf, tmp_path, decisions=3)  # of some ten: each trial begins, and none ends
    async with watched(gate.middle) as server:
        process = await started(*SIX, "--in-flight", 3, "--dask", "local:3", **server.env)
        await all_held(gate, trials=3)
        still = next(w for w in workers_of(process.pid) if held_from(gate, w))
        still.suspend()
        gate.open()
        # Each worker has two trials of 19 calls, one at a time; those of the others are made.
        async with asyncio.timeout(HANGS_S):
            while len(gate.asked) < 76:
                await asyncio.sleep(0.1)
        still.resume()
        code, _, err = await ended(process)
    assert code == 0, err
    assert not gate.asked_again


async def test_three_workers_keep_the_requests_a_minute_and_come_to_the_results_of_one_process(
    merge_runner,
):
    times = []

    async def middle(request, handler):
        times.append(time.monotonic())
        return await handler(request)

    async with watched(middle) as server:
        on_three = ("--in-flight", 3, "--dask", "local:3", "--rpm", 600)
        run = await merge_runner(*SIX, *on_three, **server.env)
        assert (run.code, "on 3 workers" in run.err) == (0, True), run.err
        # Half a second's worth goes at a time at each worker. However late they come, one limiter
        # of 600 for each would take a third of the time.
        assert len(times) <= 1.5 * 10 * (times[-1] - times[0]) + 3
        assert set(server.asked.values()) == {1}
        assert run.summary["calls"] == {"live": server.requests, "cached": 0}
        again = await merge_runner(*SIX, "--db", "again", **server.env)
        assert again.summary["calls"]["live"] == 0, "all is recorded"
    await merge_runner(*SIX, "--db", "one", "--cache", "new", code=0)
    digest = (await merge_runner("digest")).out
    assert (digest, "6 trials" in digest) == (
        (await merge_runner("digest", "--db", "one")).out,
        True,
    )


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
        env = server.account
        sweep = (*SIX, "--reps", 18, "--model", "o3", "--yes", *FAST)
        run = await merge_runner(*sweep, "--dask", "local:3", "--max-cost", cap, code=3, **env)
        assert 0 < usd <= cap
        assert run.summary["cost_usd"] == pytest.approx(usd)
        assert run.summary["sweep_cost_usd"] == pytest.approx(usd)
        assert run.summary["trials"]["suspended"] > 0
        done = await merge_runner(*sweep, "--max-cost", 50, code=0, **env)
        calls = await merge_runner("sql", "select count(*) from calls", "--format", "csv")
        assert int(calls.out.split()[1]) == server.requests, "nothing was paid for twice"
    assert done.summary["sweep_cost_usd"] == pytest.approx(usd)
    assert done.summary["set_aside_usd"] == 0


async def test_what_stops_a_sweep_stops_it_at_all_workers_in_one_line(merge_runner):
    async def middle(request, handler):
        if server.requests > 12:
            body = {"error": {"code": "insufficient_quota", "message": "nothing left"}}
            return web.json_response(body, status=429)
        return await handler(request)

    async with watched(middle) as server:
        env = server.account
        run = await merge_runner(
            *SMALL, "--conditions", "L_4_0,N_0_0", "--model", "o3", "--yes", "--dask", "local:2",
            **env,
        )  # fmt: skip
    assert run.code == 3
    assert "quota is exhausted" in run.err
    assert "Traceback" not in run.err


async def test_ctrl_c_saves_what_the_workers_have_asked(merge_runner, started, tmp_path):
    gate = Gate(math.inf, tmp_path, decisions=3)  # of some ten: each trial begins, and none ends
    async with watched(gate.middle) as server:
        process = await started(*SIX, "--in-flight", 4, "--dask", "local:2", **server.env)
        await all_held(gate, trials=4)
        process.send_signal(signal.SIGINT)
        for worker in workers_of(process.pid):
            worker.send_signal(signal.SIGINT)  # as a terminal does
        await process.said("are stored first")
        gate.open()
        code, _, err = await ended(process)
        assert code == 130, err
        assert "the replies of 2 tasks are stored first" in err
        assert "Traceback" not in err
        run = await merge_runner(*SIX, **server.env)
    assert run.code == 0, run.err
    assert not gate.asked_again
    assert len(set(gate.asked)) == 114
