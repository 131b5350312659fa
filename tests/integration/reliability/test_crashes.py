"""kill -9 at any instant: what was answered is used, and the end is that of a quiet run."""

import asyncio
import contextlib
import json
import random
import signal
import sqlite3

from merge_runner.records import SLOT_HEADER, canonical_json
from merge_runner.results.store import query, results_digest
from tests.support.harness import watched
from tests.support.mock_server import FaultPlan

SWEEP = ("sweep", "baseline", "--reps", 1, "--in-flight", 8, "--json")


def slots(server):
    """What the server was asked, in order."""
    return [headers[SLOT_HEADER.lower()] for headers in server.headers]


def kept(folder):
    """The slots with a durable reply."""
    with contextlib.closing(sqlite3.connect(f"file:{folder}/cache.db?mode=ro", uri=True)) as cache:
        rows = cache.execute("SELECT value FROM Cache WHERE length(key) = 64").fetchall()
    entries = [json.loads(text[text.index("{") :])["entry"] for (text,) in rows]
    return {canonical_json(entry["request"]["slot"]) for entry in entries}


async def kill_again_and_again(merge_runner, folder, quiet, *, kills, latency_s):
    """A sweep that is killed so many times asks nothing answered again, and ends as a quiet one."""
    chance, killed = random.Random(4), 0
    again = []  # how many slots each run asked again
    durable = []  # after each kill: the requests up to then, and the slots with a reply on disk
    async with watched(faults=FaultPlan(latency_s=latency_s)) as server:
        for _ in range(kills):
            process = await merge_runner.start(*SWEEP, **server.env)
            before = slots(server)
            # Some die while they open the files, most of them in the midst of calls.
            enough = len(before) + chance.randrange(180 // kills)
            while server.requests < enough and process.returncode is None:
                await asyncio.sleep(0.005)
            await asyncio.sleep(chance.uniform(0, 0.05))
            with contextlib.suppress(ProcessLookupError):
                process.kill()
            killed += await process.wait() == -signal.SIGKILL
            again.append(len(set(before).intersection(slots(server)[len(before) :])))
            durable.append((server.requests, kept(folder / "cache/responses")))
        last = await merge_runner(*SWEEP, **server.env)
    assert killed == kills
    assert last.code == 0, last.err
    asked = slots(server)
    for position, answered in durable:
        assert answered.isdisjoint(asked[position:]), "an answered call was made again"
    # Both drivers of at most eight trials are in flight when the process dies.
    assert max(again) <= 16
    used = last.summary["calls"]["live"] + last.summary["calls"]["cached"]
    assert used <= len(set(asked)) < len(asked)
    assert results_digest(folder / "results/merge.duckdb") == quiet


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
