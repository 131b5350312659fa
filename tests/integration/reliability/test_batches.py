"""Sweeps in batches: the results of any other, and nothing is paid twice, whatever dies when."""

from __future__ import annotations

import asyncio
import contextlib
import json
import random
import re
import shutil
import signal
from collections import Counter

import httpx
import pytest

from merge_runner.results.store import results_digest
from tests.support.harness import FAST, PROJECT, watched
from tests.support.mock_server import BatchPlan, FaultPlan

KILLS = 20
TWO = ("--conditions", "L_4_0,N_0_0", "--reps", 1)
# A stand-in that costs something, so that there is money to lose; it is told the slot.
PRICED = """
[priced]
provider = "emulator"
format = "openai-chat"
id = "scripted-driver"
max_output_tokens = 4000
price = { input = 2.0, output = 8.0, source = "made up" }
"""


def account(server):
    key, at = "a-dummy-key", server.url
    return {
        "OPENAI_API_KEY": key,
        "OPENAI_BASE_URL": f"{at}/v1",
        "ANTHROPIC_API_KEY": key,
        "ANTHROPIC_BASE_URL": at,
        "GEMINI_API_KEY": key,
        "GOOGLE_GEMINI_BASE_URL": at,
        "EMULATOR_BASE_URL": f"{at}/v1",
    }


@pytest.fixture
def priced(tmp_path):
    """A model that costs something, in trials of four decisions."""
    shutil.copytree(PROJECT / "experiments", tmp_path / "experiments")
    (tmp_path / "models.toml").write_text(PRICED)
    (tmp_path / "short.toml").write_text("[repetitions]\nbaseline = 1\n[scenario]\ntimeout_s = 4\n")


def with_terms(folder, model):
    """A study whose registry gives a model terms of its own, wherever it is asked."""
    terms = 'batch = { price_factor = 0.5, source = "as at its provider" }'
    told = (PROJECT / "experiments/models.toml").read_text()
    (folder / "models.toml").write_text(
        re.sub(rf'^\["?{re.escape(model)}"?\]$', rf"\g<0>\n{terms}", told, flags=re.MULTILINE)
    )
    shutil.copy(PROJECT / "experiments/baseline.toml", folder)


async def answered(server):
    """How often each slot was answered: in batches, and singly."""
    async with httpx.AsyncClient() as client:
        counts = (await client.get(f"{server.url}/emulator/answered")).json()
    batched, alone = Counter(), Counter()
    for each in counts:
        where = alone if each["custom_id"] is None else batched
        where[each["slot"]] += each["answered"]
    return batched, alone


async def interrupted(merge_runner, server, *command, **env):
    """What a run prints that gets Ctrl-C when a batch waits."""
    before = len(server.paths)
    process = await merge_runner.start(*command, **env)
    while not any(re.fullmatch(".*/batches/.+", path) for path in server.paths[before:]):
        await asyncio.sleep(0.02)
    process.send_signal(signal.SIGINT)
    out, err = await process.communicate()
    assert process.returncode == 130, err
    return out.decode()


async def rows(merge_runner, query, db="results/merge.duckdb"):
    return json.loads((await merge_runner("sql", query, "--db", db, "--format", "json")).out)


@pytest.mark.long
@pytest.mark.parametrize("model", ["o3", "gpt-6-sol", "claude-sonnet-4-6", "gemini-3.8-flash"])
async def test_a_sweep_in_batches_has_the_digest_of_a_plain_one(merge_runner, tmp_path, model):
    with_terms(tmp_path, model)
    sweep = ("sweep", "baseline.toml", *TWO, "--model", model, "--yes")
    async with watched(faults=FaultPlan(batch=BatchPlan(delay_s=0.1))) as server:
        env = account(server)
        plain = await merge_runner(*sweep, *FAST, "--db", "plain", "--cache", "a", **env)
        run = await merge_runner(
            *sweep, "--batch", "--json", "--db", "batch", "--cache", "b", **env
        )
    assert (plain.code, run.code) == (0, 0), plain.err + run.err
    assert results_digest(tmp_path / "plain") == results_digest(tmp_path / "batch")
    sums = "select sum(cost_usd) as usd, count(distinct batch_id) as batches from calls"
    (once,), (half,) = [await rows(merge_runner, sums, db) for db in ("plain", "batch")]
    assert half["usd"] == pytest.approx(once["usd"] / 2)
    (decisions,) = await rows(merge_runner, "select max(decision) + 1 as n from calls", "batch")
    assert (once["batches"], half["batches"]) == (0, decisions["n"])
    assert run.summary["sweep_cost_usd"] == pytest.approx(half["usd"], abs=1e-6)
    replay = await merge_runner("replay", "baseline.toml", *TWO, "--model", model, "--db", "replay",
                                "--cache", "b")  # fmt: skip
    assert replay.code == 0, replay.err
    assert results_digest(tmp_path / "replay") == results_digest(tmp_path / "plain")
    assert await rows(merge_runner, sums, "replay") == [half]


@pytest.mark.slow
async def test_a_sweep_that_is_killed_at_20_instants_pays_nothing_twice(
    merge_runner, tmp_path, priced
):
    """Half of the kills come when a batch is created and its id not told yet, or told and lost."""

    async def middle(request, handler):
        creates = request.method == "POST" and request.path == "/v1/batches"
        if creates and at == "before":
            process.kill()
        reply = await handler(request)
        if creates and at == "after":
            process.kill()
        return reply

    study = "[repetitions]\nbaseline = 1\n[scenario]\ntimeout_s = 8\n"  # enough rounds to die in
    (tmp_path / "long.toml").write_text(study)
    sweep = ("sweep", "long.toml", "--reps", 2, "--model", "priced", "--batch", "--yes", "--json")
    chance, killed = random.Random(5), 0
    plan = BatchPlan(delay_s=0.5, failed=0.1, expired=0.05)
    async with watched(middle, FaultPlan(seed=3, batch=plan)) as server:
        env = account(server)
        for number in range(KILLS):
            at = ("before", "after", "anywhere", "anywhere")[number % 4]
            process = await merge_runner.start(*sweep, **env)
            ended = asyncio.create_task(process.wait())
            patience_s = chance.uniform(0.3, 3) if at == "anywhere" else 15
            await asyncio.wait([ended], timeout=patience_s)
            with contextlib.suppress(ProcessLookupError):
                process.kill()
            killed += await ended == -signal.SIGKILL
        at = "never"
        last = await merge_runner(*sweep, **env)
        batched, alone = await answered(server)
    assert last.code == 0, last.err
    assert killed >= KILLS / 4
    assert max(batched.values()) == 1, "a call was answered in two batches"
    # As in any sweep, an answer is lost that was on its way to a call made singly.
    query = "select count(*) as n from calls where outcome = 'unknown'"
    (lost,) = await rows(merge_runner, query)
    assert len(batched.keys() & alone.keys()) <= lost["n"] <= KILLS
    assert last.summary["trials"]["failed"] == 0
    quiet = ("sweep", "long.toml", "--reps", 2, "--model", "priced", "--yes")
    async with watched() as server:
        plain = await merge_runner(*quiet, "--db", "quiet", "--cache", "new", **account(server))
    assert plain.code == 0, plain.err
    digest = results_digest(tmp_path / "results/merge.duckdb")
    assert digest == results_digest(tmp_path / "quiet")
    assert digest[1] == 22
    query = "select count(*) as n from calls where outcome = 'ok' and batch_id is not null"
    (used,) = await rows(merge_runner, query)
    assert used["n"] == batched.total()


@pytest.mark.long
async def test_a_sweep_may_change_its_mode_at_any_time(merge_runner, tmp_path, priced):
    sweep = ("sweep", "short.toml", "--model", "priced", "--yes")
    plan = FaultPlan(latency_s=0.02, batch=BatchPlan(delay_s=0.5))
    async with watched(faults=plan) as server:
        env = account(server)
        process = await merge_runner.start(*sweep, "--in-flight", 2, **env)
        while server.requests < 20:  # another process asks
            await asyncio.sleep(0.02)
        process.send_signal(signal.SIGINT)
        assert await process.wait() == 130
        await interrupted(merge_runner, server, *sweep, "--batch", **env)
        last = await merge_runner(*sweep, **env)
        batched, alone = await answered(server)
        plain = await merge_runner(*sweep, "--db", "plain", "--cache", "new", **env)
    assert (last.code, plain.code) == (0, 0), last.err
    assert "are not asked again" in last.err
    assert batched
    assert max(batched.values()) == 1
    assert not batched.keys() & alone.keys()
    digest = results_digest(tmp_path / "results/merge.duckdb")
    assert digest == results_digest(tmp_path / "plain")


@pytest.mark.long
async def test_first_situations_take_one_batch(merge_runner, tmp_path):
    first = ("sweep", "baseline", "--first", "--reps", 1)
    async with watched(faults=FaultPlan(batch=BatchPlan(polls=8))) as server:
        env = account(server)
        left = await interrupted(merge_runner, server, *first, "--batch", **env)
        run = await merge_runner(*first, "--batch", **env)
        plain = await merge_runner(*first, "--db", "plain", "--cache", "new", **env)
    assert [run.code, plain.code] == [0, 0], run.err
    assert left.count("open batch: 22 calls of emulator wait in batch ") == 1
    (batches,) = await rows(merge_runner, "select count(distinct batch_id) as n from calls")
    assert batches["n"] == 1
    assert results_digest(tmp_path / "results/merge.duckdb") == results_digest(tmp_path / "plain")


@pytest.mark.long
async def test_ctrl_c_loses_nothing_that_waits_in_a_batch(merge_runner, priced):
    sweep = ("sweep", "short.toml", *TWO, "--model", "priced", "--batch", "--yes")
    async with watched(faults=FaultPlan(batch=BatchPlan(delay_s=1.0))) as server:
        env = account(server)
        left = json.loads(await interrupted(merge_runner, server, *sweep, "--json", **env))
        last = await merge_runner(*sweep, "--json", **env)
        batched, alone = await answered(server)
    assert last.code == 0, last.err
    (told,) = left["open_batches"]
    assert "4 calls of priced wait in batch batch_" in told
    assert last.summary["open_batches"] == []
    assert max(batched.values()) == 1
    assert not alone


@pytest.mark.parametrize(
    ("options", "says"),
    [
        (("--batch", "--replay"), "leave it, --replay or --dask out"),
        (("--batch", "--dask", "local:1"), "leave it, --replay or --dask out"),
        (("--batch", "--model", "constant"), "leave it, --replay or --dask out"),
        (("--batch", "--model", "emulator"), "leave it, --replay or --dask out"),
        (("--batch", "--model", "local"), "local has no batch mode that is known; valid with"),
    ],
)
async def test_what_cannot_go_in_batches_is_refused_in_one_line(merge_runner, options, says):
    run = await merge_runner("sweep", "baseline", *options, LOCAL_MODEL="m", EMULATOR_BASE_URL="")
    assert run.code == 2
    assert says in run.err.splitlines()[-1]
    assert (run.out, run.err.count("error: ")) == ("", 1)


async def test_a_refusal_names_no_model_whose_batches_would_be_refused(merge_runner):
    run = await merge_runner(
        "sweep", "baseline", "--batch", "--model", "local", LOCAL_MODEL="m", EMULATOR_BASE_URL=""
    )
    valid = run.err.partition("valid with --batch: ")[2].partition(". ")[0].split(", ")
    assert "o3" in valid
    assert not {"emulator", "random"} & {*valid}


async def test_a_dry_run_says_what_batches_cost_beside_single_calls(merge_runner):
    run = await merge_runner(
        "sweep", "baseline", *TWO, "--model", "o3", "--batch", "--dry-run", OPENAI_API_KEY="k"
    )
    lines = run.out.splitlines()
    assert lines[4].startswith("cost    about 0.27 USD in batches; about 0.55 USD and ")
    assert lines[4].endswith(" minutes if asked singly")
    assert lines[5] == (
        "time    about 11 rounds; each takes as long as its slowest batch: minutes, an hour, a day "
        "at most"
    )
