"""Sweeps that are killed again and again."""

import contextlib
import json
import random
import signal
import sqlite3

from merge_runner.records import SLOT_HEADER, canonical_json
from merge_runner.results.store import results_digest
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
    """A sweep that is killed so many times asks nothing answered again, and ends as a quiet one.

    It dies when a request arrives at the server, or when its reply is made.
    """

    async def middle(request, handler):
        nonlocal requests
        requests -= 1
        is_last = requests == 0
        if is_last and at == "arrival":
            process.kill()
        reply = await handler(request)
        if is_last and at == "reply":
            process.kill()
        return reply

    chance, killed = random.Random(4), 0
    again = []  # how many slots each run asked again
    durable = []  # after each kill: the requests up to then, and the slots with a reply on disk
    async with watched(middle, FaultPlan(latency_s=latency_s)) as server:
        for number in range(kills):
            before = slots(server)
            at = ("arrival", "reply")[number % 2]
            requests = chance.randrange(1, 180 // kills)
            process = await merge_runner.start(*SWEEP, **server.env)
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
