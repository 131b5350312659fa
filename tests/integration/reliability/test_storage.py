"""Disks that are full, read-only, locked or damaged: one clear line, and nothing good is lost."""

import asyncio
import json
import os
import shutil
import signal
import sqlite3
import subprocess
from contextlib import closing

import duckdb
import pytest
from aiohttp import web

from merge_runner.errors import StoreLocked
from merge_runner.records import SLOT_HEADER
from merge_runner.results.database import SCHEMA_VERSION
from merge_runner.results.store import Store, results_digest
from merge_runner.run.options import Options
from merge_runner.run.plan import make_plan
from tests.support.gate import HANGS_S, Gate
from tests.support.harness import run_sweep, watched

ALL = ("sweep", "baseline", "--reps", 1, "--json")
SWEEP = (*ALL, "--conditions", "N_0_0,L_4_0")


@pytest.fixture(scope="module")
def once(prepare, tmp_path_factory):
    folder = tmp_path_factory.mktemp("once")
    assert prepare(folder, *SWEEP).code == 0
    return folder


@pytest.fixture
def stored(once, tmp_path):
    """A folder in which that sweep has been played."""
    return shutil.copytree(once, tmp_path / "stored")


async def notebook(db):
    """Another program's connection to a database, once the sweep does not just write."""
    while True:
        try:
            return duckdb.connect(str(db), read_only=True)
        except duckdb.IOException:
            await asyncio.sleep(0.01)


def line(run):
    """The one error line of a run that had nothing else to say."""
    (only,) = [text for text in run.err.splitlines() if text.startswith("error: ")]
    return only


@pytest.mark.parametrize("what", ["cache", "db"])
async def test_a_disk_that_fills_up_ends_the_run_and_the_next_one_goes_on(
    merge_runner, small_disk, quiet, what, tmp_path
):
    async with watched() as server:
        env = server.env
        with small_disk(1_024 if what == "cache" else 256) as folder:
            place = folder / what
            run = await merge_runner(*ALL, f"--{what}", place, code=1, **env)
            reason = line(run)
            assert "run the same command again" in reason
            assert "No space left" in reason or "disk is full" in reason
            assert "Traceback" not in run.err
            # With room again nothing that was kept is lost.
            moved = tmp_path / f"larger-{what}"
            subprocess.run(["cp", "-a", place, moved], check=False)  # there may be none
        answered = set(server.asked)
        again = await merge_runner(*ALL, f"--{what}", moved, **env)
    assert again.code == 0, again.err
    if what == "db":
        assert set(server.asked) == answered, "all replies were in the cache"
        assert set(server.asked.values()) == {1}
    else:
        assert again.summary["calls"]["cached"] > 0
    db = moved if what == "db" else tmp_path / "results/merge.duckdb"
    assert results_digest(db) == quiet


async def test_a_read_only_folder_is_told_before_anything_is_asked(merge_runner, read_only, stored):
    async with watched() as server:
        with read_only(stored):
            writable = {"db": stored.parent / "r.duckdb", "cache": stored.parent / "c"}
            for what, there in (
                *(("db", "results/merge.duckdb"), ("db", "new")),
                *(("cache", "cache/responses"), ("cache", "new")),
            ):
                place = stored / there
                options = [f"--{k}={path}" for k, path in {**writable, what: place}.items()]
                run = await merge_runner(*SWEEP, "--reps", 2, *options, code=2, **server.env)
                assert str(place.parent) in line(run)
                assert f"--{what}" in line(run)
    assert server.requests == 0


async def test_a_notebook_that_holds_the_database_is_named_and_ctrl_c_keeps_the_replies(
    merge_runner, tmp_path
):
    part = ("sweep", "baseline", "--conditions", "N_0_0", "--json")
    gate = Gate(8, tmp_path)  # of two trials of up to 22 calls
    async with watched(gate.middle) as server, asyncio.timeout(HANGS_S):
        env = server.env
        Store(tmp_path / "results/merge.duckdb")
        sweep = await merge_runner.start(*part, "--reps", 2, **env)
        while not gate.held:
            await asyncio.sleep(0.02)
        holder = await notebook(tmp_path / "results/merge.duckdb")
        gate.open()
        await sweep.said("the playing has ended")
        sweep.send_signal(signal.SIGINT)
        _, err = await sweep.communicate()
        err = err.decode()
        assert sweep.returncode == 130, err
        assert f"(PID {os.getpid()}): close it there" in err
        assert "run the same command again" in err
        again = await merge_runner.start(*part, "--reps", 2, **env)
        await again.said(f"(PID {os.getpid()})")
        holder.close()  # what waits for it goes on
        out, err = await again.communicate()
        assert again.returncode == 0, err
        assert json.loads(out)["calls"]["live"] == 0
        assert json.loads(out)["trials"]["planned"] == 2


async def test_what_was_dropped_is_played_again_and_failed_trials_are_kept_as_they_are(
    tmp_path, monkeypatch
):
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
    monkeypatch.setattr("merge_runner.run.writer.BATCH", 2)
    monkeypatch.setattr("merge_runner.run.playing.BATCH", 2)
    async with watched(fails) as server:
        monkeypatch.setenv("EMULATOR_BASE_URL", f"{server.url}/v1")
        conditions = ["L_4_0", "N_0_0", "R_-4_8", "L_4_8", "R_-4_0"]
        plan = make_plan("baseline", "emulator+idm", repetitions=1, conditions=conditions)
        held = await run_sweep(plan, Options(tmp_path / "held", tmp_path / "c"), say=say)
    assert any("trials that are not stored yet are played again" in line for line in said)
    assert held["exit_code"] == 1, held["messages"]
    ((trial, error),) = held["failed"].items()
    assert trial == "emulator+idm/baseline/N_0_0/rep01"
    assert "HTTP 400" in error
    assert held["calls"]["live"] == server.requests - 1
    assert results_digest(tmp_path / "held")[1] == 5


async def test_a_truncated_database_is_left_alone_and_rebuilt_from_the_cache(merge_runner, stored):
    db = stored / "results/merge.duckdb"
    digest, whole = results_digest(db), db.read_bytes()
    for before in (whole[: len(whole) // 2], whole[:999], b"no database"):
        db.write_bytes(before)
        for command in (SWEEP, ("digest",)):
            run = await merge_runner(*command, cwd=stored, code=2)
            assert "rebuilt from the cache without a call" in line(run)
            assert db.read_bytes() == before
    db.unlink()
    again = await merge_runner(*SWEEP, cwd=stored)
    assert (again.code, again.summary["calls"]["live"]) == (0, 0)
    assert results_digest(db) == digest


COMMANDS = (
    *("sweep baseline --model constant", "sweep baseline --dry-run", "digest", "sql SHOW", "audit"),
    *("tables gap", "export out", "recording export r.parquet", "view --export out"),
)


@pytest.mark.parametrize(
    ("version", "commands"), [(SCHEMA_VERSION - 1, COMMANDS), (SCHEMA_VERSION + 1, ["digest"])]
)
async def test_a_database_of_another_version_is_refused_in_one_line_and_left_as_it_is(
    merge_runner, tmp_path, version, commands
):
    db = tmp_path / "other.duckdb"
    Store(db)
    with duckdb.connect(str(db)) as connection:
        connection.execute("UPDATE meta SET schema_version = ?", [version])
    before = db.read_bytes()
    for command in commands:
        run = await merge_runner(*command.split(), "--db", db, code=2)
        (told,) = run.err.splitlines()
        assert f"other.duckdb has schema version {version}, and" in told
        assert f"merge-runner reads version {SCHEMA_VERSION}: " in told
        assert "`merge-runner sweep NAME --replay --recording FILE --db new.duckdb`" in told
    assert db.read_bytes() == before
    assert not (tmp_path / "out").exists()


async def test_one_bit_that_makes_no_text_blocks_nothing_else(merge_runner, stored):
    def run(*words):
        return merge_runner(*words, cwd=stored)

    with closing(sqlite3.connect(stored / "cache/responses/cache.db")) as database, database:
        # The top bit of the last byte, which is part of no character then.
        ((key, row, value),) = database.execute(
            "SELECT key, rowid, value FROM Cache "
            'WHERE value LIKE \'%"N_0_0"%"decision":4%\' LIMIT 1'
        )
        bent = value[:-1].encode() + bytes([ord(value[-1]) ^ 0x80])
        database.execute("UPDATE Cache SET value = CAST(? AS TEXT) WHERE rowid = ?", [bent, row])
    dry = await run(*SWEEP, "--dry-run", "--db", "new")
    assert (dry.code, dry.summary["trials"]) == (0, 1)
    replay = await run("replay", *SWEEP[1:], "--db", "replayed")
    assert replay.code == 1
    (failed,) = replay.summary["failed"].values()
    assert key in failed
    assert "no text" in failed
    export = await run("recording", "export", "rest.parquet")
    assert export.code == 1
    assert key in line(export)
    assert (await run("recording", "verify", "rest.parquet")).code == 0
    audit = await run("audit", "--cache", "cache/responses")
    assert audit.code == 1
    assert (audit.out + audit.err).count("no text") == 1
    again = await run(*SWEEP, "--db", "new")
    assert again.code == 0, again.err
    assert again.summary["damaged_entries"] == [key]
    assert f"'damaged {key}'" in again.err
    assert again.summary["calls"]["live"] == 1
    assert results_digest(stored / "new") == results_digest(stored / "results/merge.duckdb")
    assert (await run("recording", "export", "all.parquet", "--db", "new")).code == 0


async def test_a_damaged_record_of_spending_stops_no_replay(merge_runner, stored):
    with closing(sqlite3.connect(stored / "cache/responses/cache.db")) as cache, cache:
        cache.execute("INSERT INTO spent VALUES ('baseline/emulator/set0', 'm', -9.0, 0, 0)")
    for command in ((*SWEEP, "--dry-run"), ("replay", *SWEEP[1:])):
        await merge_runner(*command, "--db", "new", cwd=stored, code=0)
    for command in (SWEEP, ("ledger",)):
        refused = await merge_runner(*command, cwd=stored, code=2)
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
        run = await merge_runner(*SWEEP, **server.env)
    assert run.code == 1
    assert "was removed, moved or replaced" in line(run)
    assert "is kept" not in run.err


async def test_a_damaged_cache_file_is_told_in_one_line(merge_runner, stored):
    file = stored / "cache/responses/cache.db"
    content = file.read_bytes()
    # Of the second its first page is whole, the others are noise.
    for damaged in (b"no SQLite" + content[9:], content[:4096] + content[:4095:-1]):
        file.write_bytes(damaged)
        run = await merge_runner(*SWEEP, "--db", "new", cwd=stored)
        assert run.code in {1, 2}
        assert "Traceback" not in run.err
        assert "recording import" in line(run) or damaged[:6] == b"SQLite"
