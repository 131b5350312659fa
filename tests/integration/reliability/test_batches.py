"""Sweeps in batches: the results of any other, and nothing is paid twice, whatever dies when."""

from __future__ import annotations

import asyncio
import json
import re
import shutil
import signal
from collections import Counter

import httpx
import pytest

from merge_runner.results.store import results_digest
from tests.support.harness import FAST, PROJECT, watched
from tests.support.mock_server import BatchPlan, FaultPlan

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
    """What a run prints that gets Ctrl-C at the second look at a batch."""
    before = len(server.paths)
    process = await merge_runner.start(*command, **env)
    while sum(bool(re.search("/batches/.", path)) for path in server.paths[before:]) < 2:
        await asyncio.sleep(0.02)
    process.send_signal(signal.SIGINT)
    out, err = await process.communicate()
    assert process.returncode == 130, err
    return out.decode()


async def rows(merge_runner, query, db="results/merge.duckdb"):
    return json.loads((await merge_runner("sql", query, "--db", db, "--format", "json")).out)


async def test_a_sweep_in_batches_has_the_digest_of_a_plain_one(merge_runner, tmp_path):
    terms = 'batch = { price_factor = 0.5, source = "as at its provider" }'
    registry = (PROJECT / "experiments/models.toml").read_text()
    (tmp_path / "models.toml").write_text(registry.replace("[o3]", f"[o3]\n{terms}"))
    shutil.copy(PROJECT / "experiments/baseline.toml", tmp_path)
    sweep = ("sweep", "baseline.toml", *TWO, "--model", "o3", "--yes")
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
    replay = await merge_runner("replay", "baseline.toml", *TWO, "--model", "o3", "--db", "replay",
                                "--cache", "b")  # fmt: skip
    assert replay.code == 0, replay.err
    assert results_digest(tmp_path / "replay") == results_digest(tmp_path / "plain")
    assert await rows(merge_runner, sums, "replay") == [half]


async def test_ctrl_c_loses_nothing_that_waits_in_a_batch(merge_runner, priced):
    sweep = ("sweep", "short.toml", *TWO, "--model", "priced", "--batch", "--yes")
    async with watched(faults=FaultPlan(batch=BatchPlan(polls=8))) as server:
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
        (
            ("--batch", "--model", "local"),
            "local has no batch mode that is known; valid with --batch: o3, ",
        ),
    ],
)
async def test_what_cannot_go_in_batches_is_refused_in_one_line(merge_runner, options, says):
    run = await merge_runner("sweep", "baseline", *options, LOCAL_MODEL="m", EMULATOR_BASE_URL="")
    assert run.code == 2
    assert says in run.err.splitlines()[-1]
    assert (run.out, run.err.count("error: ")) == ("", 1)
    valid = run.err.partition("valid with --batch: ")[2].partition(". ")[0].split(", ")
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
