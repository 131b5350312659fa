"""Sweeps leave the database, and nothing that is left misses them."""

import asyncio
import json

import pytest

from merge_runner.results.store import query

PART = ("baseline", "--conditions", "N_0_0,L_4_8")
DB = "results/merge.duckdb"


@pytest.fixture
async def two_sweeps(merge_runner):
    """The ids of two sweeps: the second has the trials of the first, and as many of its own."""
    runs = [await merge_runner("sweep", *PART, "--reps", reps, "--json") for reps in (1, 2)]
    return [run.summary["sweep_id"] for run in runs]


async def test_a_forgotten_sweep_takes_what_no_other_has_which_is_played_again_without_a_call(
    merge_runner, tmp_path, two_sweeps
):
    for asked, said in (
        ((two_sweeps[0],), "nothing was removed: add --yes"),
        (("emulator/*", "--yes"), f"unknown sweep 'emulator/*'; valid: {two_sweeps[0]}"),
        (("--yes",), ""),
    ):
        refused = await merge_runner("forget", *asked)
        assert (refused.code, said in refused.err) == (2, True), refused.err
    whole = await merge_runner("digest")
    gone = await merge_runner("forget", two_sweeps[1], "--yes", code=0)
    assert f"removed: 1 sweeps ({two_sweeps[1]}) and the 2 trials of no other one" in gone.err
    left = [f"emulator/baseline/{condition}/rep01" for condition in ("L_4_8", "N_0_0")]
    for table in ("trials", "states", "decisions", "calls", "sweep_trials"):
        sql = f"select distinct trial_id from {table} order by all"
        assert query(tmp_path / DB, sql)[1] == [(trial,) for trial in left]
    assert query(tmp_path / DB, "select sweep_id from sweeps")[1] == [(two_sweeps[0],)]
    assert json.loads((await merge_runner("audit", "--json")).out)["ok"]
    shown = await merge_runner("tables", "attempts", "--format", "csv")
    again = (await merge_runner("sweep", *PART, "--reps", 2, "--json")).summary
    assert (again["calls"]["live"], again["trials"]["stored_before"]) == (0, 2)
    assert (await merge_runner("digest")).out == whole.out
    assert (await merge_runner("tables", "attempts", "--format", "csv")).out != shown.out
    assert (await merge_runner("forget", "*", "--yes")).code == 0
    for table in ("sweeps", "sweep_trials", "trials", "states", "decisions", "calls", "specs"):
        assert query(tmp_path / DB, f"from {table}")[1] == []
    assert json.loads((await merge_runner("audit", "--json")).out)["ok"]


async def test_nothing_is_forgotten_while_a_sweep_is_running(merge_runner, tmp_path):
    running = await merge_runner.start("sweep", *PART, "--reps", 9, "--rpm", 60)
    try:
        while not (told := list((tmp_path / f"{DB}.progress").glob("*.json"))):
            await asyncio.sleep(0.02)
        run = await merge_runner("forget", told[0].stem, "--yes")
        assert (run.code, "is running into" in run.err) == (2, True)
    finally:
        running.kill()
        await running.wait()
    assert (await merge_runner("forget", told[0].stem, "--yes")).code == 0, "it is dead"
