"""Two runs at once on one cache: two models share it, and one model is asked by one run."""

import asyncio
import json

import pytest

from merge_runner.errors import UsageError
from merge_runner.llm.durable import ModelLocks
from merge_runner.results.store import query
from tests.support.harness import FAST, watched
from tests.support.mock_server import FaultPlan

PART = ("baseline", "--reps", 1, "--conditions", "L_4_0,N_0_0")
SWEEP = ("sweep", *PART, "--yes", "--json", *FAST)
O3 = "o3 at openai"
MODELS = ("emulator", "o3")


async def test_runs_of_two_models_share_a_cache_and_lose_no_row(merge_runner, tmp_path):
    async with watched(faults=FaultPlan(latency_s=0.05)) as server:
        env = server.account
        runs = [await merge_runner.start(*SWEEP, "--model", model, **env) for model in MODELS]
        summaries = [json.loads((await run.communicate())[0]) for run in runs]
    assert [run.returncode for run in runs] == [0, 0]
    assert sum(summary["calls"]["live"] for summary in summaries) == server.requests
    (counted,) = query(
        tmp_path / "results/merge.duckdb",
        "select count(*), count(distinct (trial_id, side, decision, attempt)), "
        "(select count(*) from trials), (select count(*) from sweep_trials) from calls",
    )[1]
    assert counted == (server.requests, server.requests, 4, 4)


async def test_a_second_live_run_of_a_model_names_the_first_and_asks_nothing(merge_runner):
    arrived, released = asyncio.Event(), asyncio.Event()

    async def middle(request, handler):
        if arrived.is_set():  # the first call goes through
            await released.wait()
        arrived.set()
        return await handler(request)

    async with watched(middle) as server:
        env = server.account
        first = await merge_runner.start(*SWEEP, **env)
        await arrived.wait()
        second = await merge_runner(*SWEEP, "--reps", 2, "--db", "second.duckdb", **env)
        dry = await merge_runner(*SWEEP, "--dry-run", **env)
        replayed = await merge_runner("replay", *PART, "--db", "r.duckdb", **env)
        read = await merge_runner("ledger", **env)
        assert not any('"repetition":2' in asked for asked in server.asked)
        released.set()
        assert await first.wait() == 0
        after = await merge_runner(*SWEEP, "--reps", 2, "--db", "second.duckdb", **env)
        assert any('"repetition":2' in asked for asked in server.asked)
    (line,) = second.err.splitlines()[-1:]
    assert (second.code, second.out) == (2, "")
    assert f"another merge-runner (PID {first.pid} on " in line
    assert "asks scripted-driver at emulator with the cache cache/responses" in line
    assert (dry.code, read.code, after.code) == (0, 0, 0), (dry.err, read.err, after.err)
    assert replayed.code == 4, "what is not stored yet is no business of the first run"


def test_a_lock_is_of_one_model_and_nothing_is_taken_where_one_is_not_free(tmp_path):
    one, other = ModelLocks(tmp_path), ModelLocks(tmp_path)
    one.take([O3])
    with pytest.raises(UsageError, match=O3):
        other.take(["gemini-2.5-pro at gemini", O3])
    one.take(["gemini-2.5-pro at gemini"])
    assert not other.take_all()
    one.close()
    assert other.take_all()


def test_a_folder_without_locks_is_refused_before_anything_is_asked(tmp_path):
    (tmp_path / "live.lock").mkdir()
    with pytest.raises(UsageError, match=r"live\.lock cannot be locked .*--cache"):
        ModelLocks(tmp_path).take([O3])
