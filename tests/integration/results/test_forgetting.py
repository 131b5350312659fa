"""Sweeps leave the database, and nothing that is left misses them."""

from __future__ import annotations

import json

import pytest

from merge_runner.results.store import query

PART = ("baseline", "--conditions", "N_0_0,L_4_8")


@pytest.fixture
async def two_sweeps(merge_runner, tmp_path):
    """The ids of two sweeps: the second has the trials of the first, and as many of its own."""
    ids = []
    for repetitions in (1, 2):
        run = await merge_runner("sweep", *PART, "--reps", repetitions, "--json")
        assert run.code == 0, run.err
        ids.append(run.summary["sweep_id"])
    return ids


def trials(tmp_path):
    return [name for (name,) in query(tmp_path / "results/merge.duckdb",
            "select trial_id from trials order by all")[1]]  # fmt: skip


async def audited(merge_runner):
    run = await merge_runner("audit", "--json")
    return json.loads(run.out)


@pytest.mark.slow
async def test_a_forgotten_sweep_takes_only_the_trials_that_no_other_sweep_has(
    merge_runner, tmp_path, two_sweeps
):
    db = tmp_path / "results/merge.duckdb"
    gone = await merge_runner("forget", two_sweeps[1], "--yes")
    assert gone.code == 0, gone.err
    assert "and the 2 trials of no other one" in gone.err
    assert trials(tmp_path) == ["emulator/baseline/L_4_8/rep01", "emulator/baseline/N_0_0/rep01"]
    for table in ("states", "decisions", "calls", "sweep_trials"):
        assert query(db, f"select count(distinct trial_id) from {table}")[1] == [(2,)]
    assert query(db, "select sweep_id from sweeps")[1] == [(two_sweeps[0],)]
    assert (await audited(merge_runner))["ok"]


@pytest.mark.long
async def test_the_trials_of_a_forgotten_sweep_are_played_again_without_a_call(
    merge_runner, tmp_path, two_sweeps
):
    before = await merge_runner("digest")
    shown = await merge_runner("tables", "who-first", "--format", "csv")
    gone = await merge_runner("forget", two_sweeps[1], "--yes")
    assert f"removed: 1 sweeps ({two_sweeps[1]}) and the 2 trials of no other one" in gone.err
    assert (await merge_runner("tables", "who-first", "--format", "csv")).out != shown.out
    again = await merge_runner("sweep", *PART, "--reps", 2, "--json")
    assert again.summary["calls"]["live"] == 0
    assert again.summary["trials"]["stored_before"] == 2
    assert (await merge_runner("digest")).out == before.out


async def test_when_everything_is_forgotten_nothing_is_left(merge_runner, tmp_path, two_sweeps):
    assert (await merge_runner("forget", "*", "--yes")).code == 0
    for table in ("sweeps", "sweep_trials", "trials", "states", "decisions", "calls", "specs"):
        assert query(tmp_path / "results/merge.duckdb", f"from {table}")[1] == []
    assert (await audited(merge_runner))["ok"]


async def test_nothing_is_forgotten_without_a_yes_or_under_a_wrong_name(
    merge_runner, tmp_path, two_sweeps
):
    unasked = await merge_runner("forget", two_sweeps[0])
    assert unasked.code == 2
    assert "nothing was removed: add --yes" in unasked.err
    wrong = await merge_runner("forget", "emulator/baseline/*", "--yes")
    assert wrong.code == 2
    assert f"unknown sweep 'emulator/baseline/*'; valid: {two_sweeps[0]}" in wrong.err
    assert (await merge_runner("forget", "--yes")).code == 2
    assert len(trials(tmp_path)) == 4


async def test_nothing_is_forgotten_while_a_sweep_is_running(merge_runner, tmp_path, two_sweeps):
    running = await merge_runner.start("sweep", *PART, "--reps", 9, "--rpm", 60)
    try:
        folder = tmp_path / "results/merge.duckdb.progress"
        while not list(folder.glob("*.json")):
            pass
        run = await merge_runner("forget", two_sweeps[0], "--yes")
        assert run.code == 2
        assert "is running into" in run.err
    finally:
        running.kill()
        await running.wait()
    assert (await merge_runner("forget", two_sweeps[0], "--yes")).code == 0, "it is dead"
