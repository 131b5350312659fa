"""A sweep on a Dask cluster is the same sweep, whatever dies; an error is told in one line."""

import asyncio
import contextlib
import json
import logging
import math
import os
import pickle
import shutil
import socket
import sqlite3
from contextlib import closing
from functools import partial
from importlib import import_module

import psutil
import pytest

from merge_runner.errors import SweepStopped, UsageError
from merge_runner.llm.cache import ResponseCache
from merge_runner.llm.ledger import CallLabel, Cap, Ledger
from merge_runner.records import SLOT_HEADER, ReplayMiss
from merge_runner.run.cluster_connection import connected
from merge_runner.run.cluster_worker import Played, RelayedCache, unpickled
from tests.support.braking import deciding
from tests.support.cluster import SIX, SMALL, all_held, ended, held_from, repetition_of, workers_of
from tests.support.crossed_study import MODEL
from tests.support.gate import HANGS_S, Gate
from tests.support.harness import FAST, PROJECT, watched
from tests.support.virtual_time import in_virtual_time, now_s

ON_TWO = (*SIX, "--in-flight", 4, "--dask", "local:2")
# A worker is given as long as a loaded machine may need.
DEAR = MODEL.replace("price}, output = {price}", "price}, output = 2.0") + (
    "timeout_s = {hangs_s}\ndeadline_s = {hangs_s}\n"
)

RAISING = """if number == 3:
    raise ValueError("no plan")
return self.context.held(0.0)"""
RAISING_STUDY = """
models = ["emulator+raising"]
repetitions = 1
conditions = ["L_4_0", "N_0_0"]
[plugins]
files = ["mine.py"]
"""
# The attempt after six replies cannot be reserved.
UNWRITABLE = """
CREATE TRIGGER full BEFORE INSERT ON open WHEN (SELECT count(*) FROM Cache) >= 6
BEGIN SELECT RAISE(ABORT, 'the disk is full'); END
"""


@in_virtual_time
async def test_a_coordinator_that_says_nothing_ends_its_workers_tasks():
    with closing(RelayedCache("baseline", None)) as cache:
        with pytest.raises(SweepStopped, match="the coordinator has said nothing for 300 s"):
            await cache.write(partial(cache.remove, "a name"))
        assert now_s() == 300
        (operation,), _ = await cache.exchange([])
        assert operation


async def test_an_attempt_is_reserved_where_its_worker_and_the_coordinator_have_money(tmp_path):
    async def coordinate():
        results = []
        while pending := await cache.exchange(results):
            results = [await theirs.write(unpickled(each, stores)) for each in pending[0]]
        return results

    with closing(ResponseCache(tmp_path)) as theirs:
        stores = {"ledger of baseline": Ledger(theirs, "baseline", Cap(0.75))}
        with closing(RelayedCache("baseline", Cap(1.5))) as cache:
            coordinator = asyncio.create_task(coordinate())
            reserved = [
                await cache.write(partial(cache.ledger.reserve, key, 1, usd, CallLabel("o3")))
                for key, usd in (("a", 0.5), ("beyond all", 0.5), ("beyond the share", 0.75))
            ]
        assert (reserved, await coordinator) == ([True, False, False], [False])
        assert stores["ledger of baseline"].read().reserved_usd == 0.5


async def test_what_cannot_be_on_a_cluster_is_told_in_one_line(merge_runner, tmp_path):
    for word in ("local:0", "local:x", "local", "", "http://host:1", "tcp://host", "none.json"):
        with pytest.raises(UsageError, match="valid: local:N"):
            async with connected(word):
                pass
    (tmp_path / "distributed.py").write_text("raise ModuleNotFoundError('no distributed')")
    run = await merge_runner(*SMALL, "--dask", "local:2", PYTHONPATH=str(tmp_path))
    told = "error: --dask needs the package distributed: pip install 'merge-runner[dask]'\n"
    assert (run.code, run.err) == (2, told)
    told = "error: a replay needs no cluster: leave --dask out\n"
    for replay in ((*SMALL, "--replay"), ("replay", "theirs.parquet")):
        run = await merge_runner(*replay, "--dask", "local:2")
        assert (run.code, run.err) == (2, told)


async def test_no_share_of_a_limit_is_too_small_for_one_request(merge_runner):
    few = ("--first", "--reps", 1, "--conditions", "N_0_0", "--tpm", 8_000, "--dask", "local:2")
    await merge_runner("sweep", "baseline", *few, code=0)


async def test_a_cluster_of_this_machine_leaves_its_host_as_it_is_and_needs_no_certain_port(
    recwarn, caplog, monkeypatch
):
    def host():
        levels = [logging.getLogger(name).level for name in ("", "distributed", "tornado")]
        return {**os.environ}, levels

    import_module("distributed")  # its first import sets some of them
    monkeypatch.setenv("OMP_NUM_THREADS", "2")
    before = host()
    with socket.socket() as held:
        with contextlib.suppress(OSError):  # somebody holds it already
            held.bind(("127.0.0.1", 8787))
            held.listen()
        async with connected("local:1") as client:
            (safe,) = (await client.run(os.environ.get, "PYTHONSAFEPATH")).values()
            logging.getLogger("distributed.client").error("a lost worker")
            logging.getLogger("merge_runner").warning("ours")
    assert ([str(each.message) for each in recwarn], safe) == ([], "1")
    assert host() == before
    assert [each.message for each in caplog.records] == ["ours"]


async def test_workers_of_another_scheduler_play_with_their_own_keys(merge_runner, scheduler):
    async with watched() as server:
        await scheduler("--no-nanny")
        dask = ("--dask", scheduler.file)
        run = await merge_runner(*SMALL, "--model", "o3", "--yes", *dask, **server.account)
        assert (run.code, server.requests) == (2, 0)
    assert "o3 needs a key: set OPENAI_API_KEY" in run.err
    assert "(reported by the Dask worker tcp://127.0.0.1:" in run.err
    assert "Traceback" not in run.err


async def test_a_worker_with_other_source_is_refused(merge_runner, scheduler, tmp_path):
    other = shutil.copytree(PROJECT / "merge_runner", tmp_path / "other/merge_runner")
    with (other / "errors.py").open("a") as file:
        file.write("# another one\n")
    await scheduler("--no-nanny", PYTHONPATH=str(other.parent))
    run = await merge_runner(*SMALL, "--dask", scheduler.file)
    assert (run.code, "install the same one for all" in run.err) == (2, True)
    assert "Traceback" not in run.err


async def test_a_driver_that_raises_ends_the_run_once_and_what_is_paid_is_kept(
    merge_runner, scheduler, tmp_path
):
    """Nothing of the run is left at the workers."""
    (tmp_path / "mine.py").write_text(deciding(RAISING, "raising"))
    (tmp_path / "study.toml").write_text(RAISING_STUDY)
    await scheduler("--no-nanny")
    async with watched() as server:
        sweep = ("sweep", "study.toml", "--trust", "--in-flight", 2, "--dask", scheduler.file)
        run = await merge_runner(*sweep, "--json", **server.env)
        kept = len(cached_calls(tmp_path / "cache/responses"))
    assert (run.code, server.requests) == (2, kept), run.err
    assert kept >= 3
    (told,) = [line for line in run.err.splitlines() if line.startswith("error:")]
    assert "driver fails in mine.py, line 11: ValueError: no plan (reported by the Dask" in told
    assert "Traceback" not in run.err

    def names(dask_worker):
        return [name for name, part in dask_worker.extensions.items() if "WorkerRun" in repr(part)]

    async with connected(str(scheduler.file)) as client:
        assert [*(await client.run(names)).values()] == [[]]


def test_an_error_whose_class_wants_more_than_a_text_returns_from_a_worker():
    played = Played()
    played.fail(ReplayMiss("no reply", None))
    assert (played.error, played.exit_code) == ("no reply", 4)
    assert pickle.loads(pickle.dumps(played)) == played


async def test_replies_are_kept_where_the_cost_of_a_later_attempt_cannot_be_reserved(
    merge_runner, tmp_path
):
    folder = tmp_path / "cache/responses"
    ResponseCache(folder).close()
    with closing(sqlite3.connect(folder / "cache.db")) as cache:
        cache.execute(UNWRITABLE)
    (tmp_path / "models.toml").write_text(DEAR.format(name="dear", price=1.0, hangs_s=HANGS_S))
    async with watched() as server:
        sweep = (*SMALL, "--model", "dear", "--yes", *FAST, "--max-cost", 50)
        run = await merge_runner(*sweep, "--dask", "local:1", **server.env)
        assert (run.code, server.requests) == (1, 6), run.err
    assert "the disk is full" in run.err
    assert len(cached_calls(folder)) == 6


async def test_a_worker_that_is_killed_costs_its_calls_in_flight_and_nothing_else(
    merge_runner, started, tmp_path
):
    """What they may have cost stays reserved, and no answered call is made again."""
    gate = Gate(math.inf, tmp_path, decisions=3)  # of some ten: each trial begins, and none ends
    with (tmp_path / "models.toml").open("a") as file:
        file.write(DEAR.format(name="dear", price=1.0, hangs_s=HANGS_S))
    most_usd = asked_usd = 0.0

    async def middle(request, handler):
        nonlocal asked_usd, most_usd
        reply = await gate.middle(request, handler)
        usage = json.loads(reply.body)["usage"]
        usd = (usage["prompt_tokens"] + 2 * usage["completion_tokens"]) / 1e6
        most_usd = max(most_usd, usd)
        asked_usd += usd
        return reply

    async with watched(middle) as server:
        priced = ("--model", "dear", "--yes", "--max-cost", 50, *FAST)
        process = await started(*ON_TWO, *priced, **server.env)
        await all_held(gate, trials=4)
        victim = next(w for w in workers_of(process.pid) if held_from(gate, w))
        lost = held_from(gate, victim)
        victim.kill()
        await process.said("is lost: its ")
        gate.open()
        code, out, err = await ended(process)
        assert code == 0, err
        summary = json.loads(out)
        assert gate.asked_again == lost
        assert summary["trials"]["finished"] + summary["trials"]["collided"] == 6
        spent, aside = summary["sweep_cost_usd"], summary["set_aside_usd"]
        assert spent <= asked_usd + 1e-6 <= spent + aside + 2e-6
        (told,) = json.loads((await merge_runner("ledger", "--json")).out)
        assert told["open_attempts"] == len(lost)
        assert 0 < aside <= len(lost) * (most_usd + 4000 * 2 / 1e6)
        kept = [call.attempts[-1].cost_usd for call in cached_calls(tmp_path / "cache/responses")]
        assert (len(kept), sum(kept)) == (114, pytest.approx(spent))
        requests = server.requests
        plain = await merge_runner(*SIX, *priced, "--db", "plain", **server.env)
        assert (plain.code, server.requests) == (0, requests), "a reply is not kept"
    digests = {(await merge_runner("digest", *db)).out for db in ((), ("--db", "plain"))}
    assert len(digests) == 1


async def test_a_coordinator_that_is_killed_takes_its_workers_along_and_goes_on(
    merge_runner, started, tmp_path
):
    """Only what was sent stays reserved."""
    held, go_on = set(), asyncio.Event()
    (tmp_path / "models.toml").write_text(DEAR.format(name="dear", price=1.0, hangs_s=HANGS_S))

    async def middle(request, handler):
        slot = request.headers[SLOT_HEADER]
        if repetition_of(slot)[1] == 4 and not go_on.is_set():  # most of the last task
            held.add(slot)
            await go_on.wait()
        return await handler(request)

    # Three tasks of four trials, the last of which no one ends.
    many = (*SIX, "--reps", 4, "--model", "dear", "--yes", *FAST, "--max-cost", 50)
    async with watched(middle) as server, asyncio.timeout(HANGS_S):
        process = await started(*many, "--in-flight", 2, "--dask", "local:2", **server.env)
        while not (held and (kept := len(cached_calls(tmp_path / "cache/responses")))):
            await asyncio.sleep(0.1)
        family = psutil.Process(process.pid).children(recursive=True)
        process.kill()
        await process.wait()
        _, alive = psutil.wait_procs(family, timeout=HANGS_S)
        assert not alive
        (told,) = json.loads((await merge_runner("ledger", "--json")).out)
        assert 1 <= told["open_attempts"] <= server.requests - kept
        # At most 4,000 tokens of output, at 2 USD a million, and a prompt of some thousand.
        assert 0 < told["reserved_usd"] < 0.015 * told["open_attempts"]
        go_on.set()
        run = await merge_runner(*many, **server.env)
        assert run.code == 0, run.err
        # Their trials may be stored, too, before the kill comes.
        assert run.summary["calls"]["cached"] >= kept or run.summary["trials"]["stored_before"]
        asked_for = len(cached_calls(tmp_path / "cache/responses"))
        assert server.requests - asked_for <= told["open_attempts"]
    assert run.summary["trials"]["finished"] + run.summary["trials"]["collided"] == 12
    assert run.summary["set_aside_usd"] == pytest.approx(told["reserved_usd"])


def cached_calls(folder):
    """The calls in a cache, which may not be there yet."""
    if not (folder / "cache.db").exists():
        return []
    with closing(ResponseCache(folder, read_only=True)) as cache:
        return list(cache.entries())
