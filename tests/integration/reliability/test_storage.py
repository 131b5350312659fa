"""Disks that are full, read-only, locked or damaged: one clear line, and nothing good is lost."""

from __future__ import annotations

import asyncio
import json
import shutil
import signal
import sqlite3
import sys

import duckdb
import pytest
from aiohttp import web

from merge_runner.errors import StoreLocked
from merge_runner.records import SLOT_HEADER
from merge_runner.results.database import SCHEMA_VERSION
from merge_runner.results.store import Store, results_digest
from merge_runner.run.plan import Options, make_plan
from tests.support.gate import HANGS_S, Gate
from tests.support.harness import FAST, run_sweep, watched

SWEEP = ("sweep", "baseline", "--reps", 1, "--json")
NOTEBOOK = """
import duckdb, sys, time
while True:
    try:
        held = duckdb.connect(sys.argv[1], read_only=sys.argv[2] == "read")
        break
    except duckdb.IOException:  # the sweep writes just now
        time.sleep(0.01)
print("held", flush=True)
sys.stdin.read()
"""


async def notebook(db, mode):
    """Another program that holds a database until its standard input closes."""
    process = await asyncio.create_subprocess_exec(
        sys.executable, "-c", NOTEBOOK, db, mode,
        stdin=asyncio.subprocess.PIPE, stdout=asyncio.subprocess.PIPE,
    )  # fmt: skip
    assert await process.stdout.readline() == b"held\n"
    return process


def line(run):
    """The one error line of a run that had nothing else to say."""
    (only,) = [text for text in run.err.splitlines() if text.startswith("error: ")]
    return only


@pytest.mark.parametrize("what", ["cache", "db"])
async def test_a_disk_that_fills_up_ends_the_run_and_the_next_one_goes_on(
    merge_runner, small_disk, quiet, what, tmp_path
):
    async with watched() as server:
        env = {"EMULATOR_BASE_URL": f"{server.url}/v1"}
        with small_disk(1 if what == "cache" else 2) as folder:
            place = folder / what
            run = await merge_runner(*SWEEP, f"--{what}", place, **env)
            assert run.code == 1, run.err
            assert "run the same command again" in line(run)
            assert "Traceback" not in run.err
            # With room again nothing that was kept is lost.
            moved = tmp_path / f"larger-{what}"
            if place.is_dir():
                await copied(place, moved)
            elif place.exists():
                moved.write_bytes(place.read_bytes())
        answered = set(server.asked)
        again = await merge_runner(*SWEEP, f"--{what}", moved, **env)
    assert again.code == 0, again.err
    if what == "db":
        assert set(server.asked) == answered, "all replies were in the cache"
        assert set(server.asked.values()) == {1}
    else:
        assert again.summary["calls"]["cached"] > 0
    db = moved if what == "db" else tmp_path / "results/merge.duckdb"
    assert results_digest(db) == quiet


async def copied(source, target):
    process = await asyncio.create_subprocess_exec("cp", "-a", source, target)
    assert await process.wait() == 0


@pytest.mark.parametrize("what", ["cache", "db"])
async def test_a_read_only_folder_is_told_before_anything_is_asked(
    merge_runner, read_only, tmp_path, what
):
    folder = tmp_path / "results"
    async with watched() as server:
        env = {"EMULATOR_BASE_URL": f"{server.url}/v1"}
        place = folder / ("r.duckdb" if what == "db" else "responses")
        sweep = (*SWEEP, "--conditions", "R_-4_8")
        assert (await merge_runner(*sweep, f"--{what}", place, **env)).code == 0
        asked = server.requests
        for again in (place, folder / "new"):
            with read_only(folder):
                run = await merge_runner(*sweep, "--reps", 2, f"--{what}", again, **env)
            assert run.code == 2, run.err
            assert str(again.parent) in line(run)
            assert f"--{what}" in line(run)
        assert server.requests == asked


@pytest.mark.parametrize("mode", ["read", "write"])
async def test_a_notebook_that_holds_the_database_is_named_and_ctrl_c_keeps_the_replies(
    merge_runner, tmp_path, mode
):
    part = ("sweep", "baseline", "--conditions", "N_0_0", "--json")
    gate = Gate(30, tmp_path)  # of three trials of up to 22 calls
    async with watched(gate.middle) as server, asyncio.timeout(HANGS_S):
        env = {"EMULATOR_BASE_URL": f"{server.url}/v1"}
        assert (await merge_runner(*part, "--reps", 1, **env)).code == 0
        sweep = await merge_runner.start(*part, "--reps", 3, **env)
        while not gate.held:
            await asyncio.sleep(0.02)
        holder = await notebook(tmp_path / "results/merge.duckdb", mode)
        gate.open()
        await sweep.said("the playing has ended")
        sweep.send_signal(signal.SIGINT)
        _, err = await sweep.communicate()
        err = err.decode()
        assert sweep.returncode == 130, err
        assert f"(PID {holder.pid}): close it there" in err
        assert "run the same command again" in err
        again = await merge_runner.start(*part, "--reps", 3, **env)
        await again.said(f"(PID {holder.pid})")
        holder.stdin.close()  # what waits for it goes on
        out, err = await again.communicate()
        assert again.returncode == 0, err
        assert json.loads(out)["calls"]["live"] == 0
        assert json.loads(out)["trials"]["planned"] == 3


SHORT = """
models = ["emulator"]
repetitions = 30
conditions = ["L_4_0", "N_0_0", "R_-4_0", "L_2_-8", "R_-2_8", "L_4_8", "R_-4_8", "L_4_-8", "L_0_-8",
    "R_0_8"]
[scenario]
timeout_s = 2
"""


async def test_a_notebook_that_holds_the_database_all_night_costs_no_trial_and_no_call(
    merge_runner, tmp_path
):
    (tmp_path / "short.toml").write_text(SHORT)
    sweep = ("sweep", "short.toml", "--json", *FAST)
    gate = Gate(30, tmp_path)
    async with watched(gate.middle) as server:
        env = {"EMULATOR_BASE_URL": f"{server.url}/v1"}
        night = await merge_runner.start(*sweep, **env)
        while not gate.held:
            await asyncio.sleep(0.02)
        holder = await notebook(tmp_path / "results/merge.duckdb", "write")
        gate.open()
        await night.said("the playing has ended; 300 trials wait to be stored")
        asked = server.requests
        holder.stdin.close()
        out, err = await night.communicate()
    assert night.returncode == 0, err
    summary = json.loads(out)
    assert summary["trials"]["planned"] == summary["trials"]["timeout"] == 300
    assert summary["audit"]["findings"] == []
    assert server.requests == asked
    assert max(server.asked.values()) == 1
    assert b"44 trials that are not stored yet are played again from the recorded" in err
    assert summary["calls"]["live"] == asked
    again = await merge_runner("replay", "short.toml", "--db", "again.duckdb")
    assert again.code == 0, again.err
    digest = results_digest(tmp_path / "results/merge.duckdb")
    assert digest == results_digest(tmp_path / "again.duckdb")
    assert digest[1] == 300


async def test_what_was_dropped_is_played_again_and_failed_trials_are_kept_as_they_are(
    tmp_path, monkeypatch
):
    """A few may wait here, so that a few trials are enough."""

    def write(store, *args, **options):
        if not is_free:
            raise StoreLocked("somebody reads")
        return written(store, *args, **options)

    def say(line):
        said.append(line)
        if "the playing has ended" in line:
            is_free.append(True)

    async def fails(request, handler):
        slot = json.loads(request.headers[SLOT_HEADER])
        if slot["condition"] == "N_0_0" and slot["decision"] == 2:
            return web.json_response({"error": {"message": "no"}}, status=400)
        return await handler(request)

    said, is_free, written = [], [], Store.write
    monkeypatch.setattr(Store, "write", write)
    monkeypatch.setattr("merge_runner.run.local_runner.BATCH", 2)
    monkeypatch.setattr("merge_runner.run.sweep.BATCH", 2)
    async with watched(fails) as server:
        monkeypatch.setenv("EMULATOR_BASE_URL", f"{server.url}/v1")
        plan = make_plan("baseline", "emulator+idm", repetitions=1)
        held = await run_sweep(plan, Options(tmp_path / "held", tmp_path / "c"), say=say)
    assert any("trials that are not stored yet are played again" in line for line in said)
    assert held["exit_code"] == 1, held["messages"]
    ((trial, error),) = held["failed"].items()
    assert trial == "emulator+idm/baseline/N_0_0/rep01"
    assert "HTTP 400" in error
    assert held["calls"]["live"] == server.requests - 1
    assert results_digest(tmp_path / "held")[1] == 11


async def test_a_truncated_database_is_left_alone_and_rebuilt_from_the_cache(
    merge_runner, tmp_path, quiet
):
    db = tmp_path / "results/merge.duckdb"
    async with watched() as server:
        env = {"EMULATOR_BASE_URL": f"{server.url}/v1"}
        assert (await merge_runner(*SWEEP, **env)).code == 0
        asked = server.requests
        for kept in (0.6, 0.001):
            db.write_bytes(db.read_bytes()[: int(db.stat().st_size * kept)])
            before = db.read_bytes()
            for command in (SWEEP, ("digest",), ("tables", "who-first")):
                run = await merge_runner(*command, **env)
                assert run.code == 2, (command, run.err)
                assert "rebuilt from the cache without a call" in line(run)
                assert db.read_bytes() == before
        db.rename(tmp_path / "damaged")
        assert (await merge_runner(*SWEEP, **env)).code == 0
        assert server.requests == asked
    assert results_digest(db) == quiet


@pytest.mark.parametrize("version", [SCHEMA_VERSION - 1, SCHEMA_VERSION + 1])
async def test_a_database_of_another_version_is_refused_in_one_line_and_left_as_it_is(
    merge_runner, tmp_path, version
):
    db = tmp_path / "other.duckdb"
    Store(db)
    with duckdb.connect(str(db)) as connection:
        connection.execute("UPDATE meta SET schema_version = ?", [version])
    before = db.read_bytes()
    for command in (
        "sweep baseline --model constant", "sweep baseline --dry-run", "digest", "sql SHOW",
        "tables gap", "audit", "export out", "recording export r.parquet", "view --export out",
    ):  # fmt: skip
        run = await merge_runner(*command.split(), "--db", db)
        assert run.code == 2, command
        (told,) = run.err.splitlines()
        assert f"other.duckdb has schema version {version}, and" in told
        assert f"merge-runner reads version {SCHEMA_VERSION}: " in told
        assert "`merge-runner sweep NAME --replay --recording FILE --db new.duckdb`" in told
        assert db.read_bytes() == before
    assert not (tmp_path / "out").exists()


async def test_a_damaged_reply_is_asked_again_in_a_sweep_and_never_in_a_replay(
    merge_runner, tmp_path, stock, quiet
):
    async with watched() as server:
        env = {"EMULATOR_BASE_URL": f"{server.url}/v1"}
        await merge_runner(*SWEEP, **env)
        with stock(tmp_path / "cache/responses") as cache:
            key = next(key for key in cache if len(key) == 64)
            cache[key] = damaged = cache[key].replace("0.0", "0.9", 1)
        asked = server.requests
        replay = await merge_runner("replay", *SWEEP[1:], "--db", "new", **env)
        assert replay.code == 1
        (failed,) = replay.summary["failed"].values()
        assert key in failed
        assert "damaged" in failed
        assert server.requests == asked
        run = await merge_runner(*SWEEP, "--db", "new", **env)
        assert run.code == 0, run.err
        assert run.summary["damaged_entries"] == [key]
        assert f"'damaged {key}'" in run.err
        assert server.requests == asked + 1
    with stock(tmp_path / "cache/responses") as cache:
        assert cache[f"damaged {key}"] == damaged
    assert results_digest(tmp_path / "new") == quiet


async def test_one_bit_that_makes_no_text_blocks_nothing_else(merge_runner, tmp_path):
    part = ("baseline", "--reps", 1, "--conditions", "N_0_0,L_4_0")
    folder = tmp_path / "cache/responses"
    async with watched() as server:
        env = {"EMULATOR_BASE_URL": f"{server.url}/v1"}
        assert (await merge_runner("sweep", *part, **env)).code == 0
        with sqlite3.connect(folder / "cache.db") as database:
            # The top bit of the last byte, which is part of no character then.
            ((key, row),) = database.execute(
                'SELECT key, rowid FROM Cache WHERE value LIKE \'%"N_0_0"%"decision":4%\' LIMIT 1'
            )
            ((value,),) = database.execute(f"SELECT value FROM Cache WHERE rowid = {row}")
            bent = value[:-1].encode() + bytes([ord(value[-1]) ^ 0x80])
            database.execute(
                "UPDATE Cache SET value = CAST(? AS TEXT) WHERE rowid = ?", [bent, row]
            )
        database.close()
        asked = server.requests
        dry = await merge_runner("sweep", *part, "--dry-run", "--json", "--db", "new", **env)
        assert (dry.code, dry.summary["trials"]) == (0, 1)
        replay = await merge_runner("replay", *part, "--json", "--db", "replayed", **env)
        assert replay.code == 1
        (failed,) = replay.summary["failed"].values()
        assert key in failed
        assert "no text" in failed
        export = await merge_runner("recording", "export", "rest.parquet", **env)
        assert export.code == 1
        assert key in line(export)
        assert (await merge_runner("recording", "verify", "rest.parquet")).code == 0
        audit = await merge_runner("audit", "--cache", folder, **env)
        assert audit.code == 1
        assert (audit.out + audit.err).count("no text") == 1
        assert server.requests == asked
        run = await merge_runner("sweep", *part, "--json", "--db", "new", **env)
        assert run.code == 0, run.err
        assert run.summary["damaged_entries"] == [key]
        assert server.requests == asked + 1
        whole = ("recording", "export", "all.parquet", "--db", "new")
        assert (await merge_runner(*whole, **env)).code == 0


async def test_a_damaged_record_of_spending_stops_no_replay(merge_runner, tmp_path):
    part = ("baseline", "--reps", 1, "--conditions", "N_0_0", "--json")
    assert (await merge_runner("sweep", *part)).code == 0
    (tmp_path / "cache/responses/ledger.db").write_text("damaged")
    assert (await merge_runner("sweep", *part, "--dry-run", "--db", "new")).code == 0
    replay = await merge_runner("replay", *part, "--db", "new")
    assert replay.code == 0, replay.err
    for command in (("sweep", *part), ("ledger",)):
        refused = await merge_runner(*command)
        assert refused.code == 2
        assert "no cap could hold" in refused.err


async def test_a_cache_that_goes_away_during_a_run_is_not_said_to_keep_everything(
    merge_runner, tmp_path
):
    folder = tmp_path / "cache/responses"

    async def middle(request, handler):
        if server.requests == 9:
            shutil.rmtree(folder)
        return await handler(request)

    async with watched(middle) as server:
        run = await merge_runner(*SWEEP, EMULATOR_BASE_URL=f"{server.url}/v1")
    assert run.code == 1
    assert "was removed, moved or replaced" in line(run)
    assert "is kept" not in run.err


async def test_a_damaged_cache_file_is_told_in_one_line(merge_runner, tmp_path):
    await merge_runner(*SWEEP)
    file = tmp_path / "cache/responses/cache.db"
    content = file.read_bytes()
    file.write_bytes(b"no SQLite" + content[9:])
    run = await merge_runner(*SWEEP, "--db", "new")
    assert run.code == 2
    assert "recording import" in line(run)
    # Its first page is whole, the others are noise.
    file.write_bytes(content[:4096] + bytes(reversed(content[4096:])))
    run = await merge_runner(*SWEEP, "--db", "new")
    assert run.code in {1, 2}
    assert "Traceback" not in run.err
    assert line(run)


async def test_results_say_what_a_database_is_not(merge_runner, tmp_path):
    (tmp_path / "text.duckdb").write_text("no database")
    run = await merge_runner(*SWEEP, "--db", "text.duckdb")
    assert run.code == 2
    assert json.dumps("text.duckdb").strip('"') in line(run)
