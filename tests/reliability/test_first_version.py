"""Recordings are data and outlive the code: what the first version wrote is read for ever."""

from __future__ import annotations

import hashlib
import re
import tarfile
from pathlib import Path

import duckdb
import pytest

from merge_runner.llm.cache_db import FORMAT
from merge_runner.results.database import SCHEMA_VERSION
from merge_runner.results.store import Store
from tests.harness import PROJECT

pytestmark = pytest.mark.long

ARCHIVE = PROJECT / "tests/data/first-version.tar.gz"
# As the first version printed it.
DIGEST = "994fd80fb9b17a385b8aac6086b4c3cb4ed1db1f7abf75af83222c6a07ba3203  1 trials\n"
REPLAY = ("replay", "baseline", "--reps", 1, "--conditions", "L_4_0", "--cache", "cache")


@pytest.fixture
def old(tmp_path):
    with tarfile.open(ARCHIVE) as archive:
        archive.extractall(tmp_path, filter="data")
    return tmp_path


def content(path: Path):
    return hashlib.sha256(path.read_bytes()).hexdigest()


async def test_its_database_is_brought_up_to_date_and_kept(merge_runner, old):
    before = content(old / "results.duckdb")
    run = await merge_runner("replay", "baseline", "--model", "constant", "--reps", 1,
                             "--db", "results.duckdb")  # fmt: skip
    assert run.code == 0, run.err
    assert "was brought from schema 1" in run.err
    assert content(old / "results.v1.duckdb") == before
    digest = await merge_runner("digest", "--db", "results.duckdb")
    assert (digest.out.split()[1:], digest.err) == (["12", "trials"], "")
    with duckdb.connect(str(old / "results.duckdb"), read_only=True) as database:
        assert database.execute("FROM meta").fetchall() == [(SCHEMA_VERSION,)]
        calls = database.execute("SELECT count(*), count(started_at) FROM calls").fetchone()
        assert calls == (19, 0)
        assert database.execute(
            "SELECT DISTINCT provider, calls.scripted, trials.scripted "
            "FROM calls JOIN trials USING (trial_id, spec_hash)"
        ).fetchall() == [("emulator", True, True)]
        (failed,) = database.execute(
            "SELECT count(*) FROM attempts WHERE fate IN ('retried', 'fallback')"
        ).fetchone()
        assert failed == 4


async def test_a_reply_that_says_it_was_scripted_is_so_in_an_old_database_too(merge_runner, old):
    with duckdb.connect(str(old / "results.duckdb")) as database:
        database.execute("UPDATE calls SET provider = 'openai'")
        database.execute("UPDATE trials SET scripted = false")
        told = ['{"merge_runner_scripted": true}']
        database.execute("UPDATE calls SET reply = ? WHERE side = 'left' AND decision = 0", told)
    Store(old / "results.duckdb")
    with duckdb.connect(str(old / "results.duckdb"), read_only=True) as database:
        found = "SELECT DISTINCT side, decision FROM calls WHERE scripted"
        assert database.execute(found).fetchall() == [("left", 0)]
        assert database.execute("SELECT scripted FROM trials").fetchall() == [(True,)]


READING = {
    "digest": ("digest",),
    "sql": ("sql", "SELECT fate FROM attempts WHERE NOT scripted"),
    "audit": ("audit", "--cache", "cache"),
    "recording export": ("recording", "export", "../exported.parquet", "--cache", "cache"),
    "sweep --dry-run": ("sweep", "baseline", "--dry-run"),
}


@pytest.mark.parametrize("what", READING)
async def test_what_reads_its_database_writes_nothing_there(merge_runner, old, what):
    def files():
        return {path: content(path) for path in old.rglob("results*")}

    before = files()
    run = await merge_runner(*READING[what], "--db", "results.duckdb")
    assert run.code == 0, run.err
    assert run.err.count("has an older schema and is left as it is") == 1
    (copy,) = re.findall(r"a copy of it, (\S+),", run.err)
    assert not Path(copy).parent.exists()
    assert files() == before


async def test_a_sweep_goes_on_in_its_database(merge_runner, old):
    run = await merge_runner("sweep", "baseline", "--reps", 1, "--model", "constant",
                             "--db", "results.duckdb", "--json")  # fmt: skip
    assert run.code == 0, run.err
    both = await merge_runner("sql", "select count(*) as n from trials", "--db", "results.duckdb")
    assert both.out.split() == ["n", "12"]


async def test_its_cache_replays_to_the_same_digest(merge_runner, old):
    run = await merge_runner(*REPLAY, "--db", "new.duckdb", "--json")
    assert run.code == 0, run.err
    assert run.summary["calls"] == {"live": 0, "cached": 18}
    assert (await merge_runner("digest", "--db", "new.duckdb")).out == DIGEST


async def test_its_database_in_a_folder_that_cannot_be_written_is_read(
    merge_runner, old, read_only
):
    with read_only(old):
        run = await merge_runner("digest", "--db", "results.duckdb")
    assert (run.code, run.out) == (0, DIGEST)


async def test_a_newer_database_is_left_alone(merge_runner, old):
    with duckdb.connect(str(old / "results.duckdb")) as database:
        database.execute("UPDATE meta SET schema_version = 99")
    before = content(old / "results.duckdb")
    for command in (("digest",), ("sweep", "baseline", "--model", "constant")):
        run = await merge_runner(*command, "--db", "results.duckdb")
        assert run.code == 2
        assert "schema version 99, written by a newer merge-runner" in run.err
        assert run.err.count("\n") == 1
    assert content(old / "results.duckdb") == before


async def test_a_newer_cache_is_left_alone(merge_runner, old, stock):
    with stock(old / "cache") as cache:
        cache["format"] = str(FORMAT + 1)
    run = await merge_runner(*REPLAY)
    assert run.code == 2
    assert f"format {FORMAT + 1}, written by a newer merge-runner" in run.err
    assert run.err.count("\n") == 1


async def test_a_newer_reply_in_a_cache_of_today_stops_the_sweep(merge_runner, old, stock):
    await merge_runner(*REPLAY)
    with stock(old / "cache") as cache:
        key = next(key for key in cache if len(key) == 64)
        text = cache[key] = cache[key].replace('{"version":1', '{"version":2', 1)
    run = await merge_runner(*REPLAY, "--db", "new.duckdb")
    assert run.code == 2
    assert "update merge-runner" in run.err
    with stock(old / "cache") as cache:
        assert cache[key] == text
