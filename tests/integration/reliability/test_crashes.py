"""kill -9 at any instant: what was answered is used, and the end is that of a quiet run."""

import asyncio

from merge_runner.results.store import query
from tests.support.harness import watched
from tests.support.kills import kill_again_and_again
from tests.support.mock_server import FaultPlan


async def test_a_sweep_that_is_killed_again_and_again_asks_nothing_answered_again(
    merge_runner, quiet, tmp_path
):
    await kill_again_and_again(merge_runner, tmp_path, quiet, kills=6, latency_s=0.02)


async def test_attempts_of_a_run_that_died_are_found_in_the_next_one(merge_runner, tmp_path):
    async def middle(request, handler):
        if not release.is_set():
            hanging.set()
            await release.wait()
        return await handler(request)

    hanging, release = asyncio.Event(), asyncio.Event()
    study = 'repetitions = 1\nconditions = ["L_4_0"]\n[scenario]\ntimeout_s = 4\n'
    (tmp_path / "short.toml").write_text(study)
    sweep = ("sweep", "short.toml", "--model", "emulator", "--json")
    async with watched(middle, FaultPlan(rates={"server_error": 0.1}, seed=3)) as server:
        process = await merge_runner.start(*sweep, **server.env)
        await hanging.wait()
        process.terminate()
        release.set()
        await process.wait()
        done = await merge_runner(*sweep, **server.env)
    assert done.code == 0, done.err
    ((total, distinct, retried),) = query(
        tmp_path / "results/merge.duckdb",
        "select count(*), count(distinct (side, decision, attempt)), "
        "count(*) filter (fate = 'retried') from attempts",
    )[1]
    assert total == distinct == server.requests
    assert retried > 0
