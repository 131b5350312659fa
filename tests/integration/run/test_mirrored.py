"""A pair that is played both ways round, from the sweep to the tables."""

from __future__ import annotations

import asyncio

import pytest

from merge_runner.results.store import results_digest
from tests.support.harness import watched
from tests.support.mock_server import FaultPlan

PAIR = ("baseline", "--model", "emulator+projected-order", "--mirror", "--reps", 1)


@pytest.mark.long
async def test_a_mirrored_pair_is_killed_resumed_and_replayed_to_the_same_end(
    merge_runner, tmp_path
):
    begun = asyncio.Event()

    async def begin(request, handler):
        begun.set()
        return await handler(request)

    async with watched(begin, FaultPlan(latency_s=0.02)) as server:
        env = {"EMULATOR_BASE_URL": f"{server.url}/v1"}
        sweep = ("sweep", *PAIR, "--in-flight", 2, "--json")
        process = await merge_runner.start(*sweep, **env)
        await begun.wait()
        await asyncio.sleep(0.3)
        process.kill()
        assert await process.wait() != 0
        resumed = await merge_runner(*sweep, **env)
        assert (resumed.code, resumed.summary["trials"]["planned"]) == (0, 22), resumed.err
        done = server.requests
        again = await merge_runner("replay", *PAIR, "--db", "again.duckdb", **env)
        assert again.code == 0, again.err
        assert server.requests == done
    digest = results_digest(tmp_path / "results/merge.duckdb")
    assert digest == results_digest(tmp_path / "again.duckdb")
    assert digest[1] == 22
    audit = await merge_runner("audit")
    assert audit.code == 0, audit.out
    tables = await merge_runner("tables", "ablation-quantitative", "--format", "csv")
    assert "emulator+projected-order/baseline" in tables.out
    assert "projected-order+emulator" not in tables.out
    notes = (await merge_runner("tables", "who-first")).out
    assert "emulator sat on the left in 11 trials, and on the right in 11, mirrored" in " ".join(
        notes.split()
    )


async def test_the_summary_names_a_pair_as_the_tables_do(merge_runner):
    part = ("--reps", 1, "--conditions", "L_4_0")
    run = await merge_runner(
        "sweep", "baseline", "--model", "projected-order+constant", "--model", "constant", *part
    )
    assert run.code == 0, run.err
    counts = {line.split()[0]: line.split()[1] for line in run.out.splitlines() if line}
    assert counts["constant+projected-order"] == counts["constant"] == "1"
