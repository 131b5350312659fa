"""Sweeps in batches: the results of any other, and nothing is paid twice, whatever dies when."""

import asyncio
import json
import re
import signal

import pytest

from merge_runner.results.store import results_digest
from tests.support.harness import FAST, a_model, watched
from tests.support.mock_server import BatchPlan, FaultPlan
from tests.support.priced import PRICE, answered, rows

TWO = ("--conditions", "L_4_0,N_0_0", "--reps", 1)


class Looks:
    """Holds the second look at a batch, and all after it, until they may be ``answered``."""

    def __init__(self):
        self.seen = 0
        self.second, self.answered = asyncio.Event(), asyncio.Event()

    async def middle(self, request, handler):
        if re.search("/batches/.", request.path):
            self.seen += 1
            if self.seen >= 2:
                self.second.set()
                await self.answered.wait()
        return await handler(request)


async def interrupted(merge_runner, looks, *command, **env):
    """What a run prints that gets Ctrl-C at the second look at a batch."""
    process = await merge_runner.start(*command, **env)
    await looks.second.wait()
    process.send_signal(signal.SIGINT)
    out, err = await process.communicate()
    looks.answered.set()
    assert process.returncode == 130, err
    return out.decode()


async def test_a_sweep_in_batches_is_paid_and_replayed_as_any_other(merge_runner, priced, tmp_path):
    terms = {"price_factor": 0.5, "source": "as at its provider"}
    (tmp_path / "models.toml").write_text(a_model("priced", price=PRICE, batch=terms))
    sweep = ("short.toml", *TWO, "--model", "priced", "--json")
    async with watched(faults=FaultPlan(batch=BatchPlan(delay_s=0.1))) as server:
        run = await merge_runner("sweep", *sweep, "--batch", "--yes", *FAST, **server.account)
    assert run.code == 0, run.err
    sums = (
        "select sum(cost_usd) as usd, sum(input_tokens * 1e-6 + output_tokens * 4e-6) as half, "
        "count(distinct batch_id) as batches, max(decision) + 1 as decisions from calls"
    )
    (told,) = await rows(merge_runner, sums)
    assert told["usd"] == pytest.approx(told["half"])
    assert told["batches"] == told["decisions"]
    assert run.summary["sweep_cost_usd"] == pytest.approx(told["usd"], abs=1e-6)
    await merge_runner("replay", *sweep, "--db", "replay", code=0)
    assert results_digest(tmp_path / "replay") == results_digest(tmp_path / "results/merge.duckdb")
    assert await rows(merge_runner, sums, "replay") == [told]


async def test_ctrl_c_loses_nothing_that_waits_in_a_batch(merge_runner, priced):
    sweep = ("sweep", "short.toml", *TWO, "--model", "priced", "--batch", "--yes")
    looks = Looks()
    async with watched(looks.middle, FaultPlan(batch=BatchPlan(polls=5))) as server:
        env = server.account
        left = json.loads(await interrupted(merge_runner, looks, *sweep, "--json", **env))
        last = await merge_runner(*sweep, "--json", **env)
        batched, alone = await answered(server)
    assert last.code == 0, last.err
    (told,) = left["open_batches"]
    assert "4 calls of priced wait in batch batch_" in told
    assert last.summary["open_batches"] == []
    assert max(batched.values()) == 1
    assert not alone


async def test_what_cannot_go_in_batches_is_refused_in_one_line(merge_runner):
    sweep = ("sweep", "baseline", "--batch")
    for options in ("--replay", "--dask local:1", "--model constant", "--model emulator"):
        run = await merge_runner(*sweep, *options.split(), EMULATOR_BASE_URL="")
        assert (run.code, run.out, run.err.count("error: ")) == (2, "", 1)
        assert "leave it, --replay or --dask out" in run.err.splitlines()[-1]
    run = await merge_runner(*sweep, "--model", "local", LOCAL_MODEL="m", EMULATOR_BASE_URL="")
    said, _, valid = run.err.splitlines()[-1].partition("; valid with --batch: ")
    assert "local has no batch mode that is known" in said
    assert re.search(r"or give \[local\] in /.*/experiments/models.toml `batch =", valid)
    assert "o3" in valid
    assert not {"emulator", "random"} & {*valid.partition(". ")[0].split(", ")}


async def test_a_dry_run_says_what_batches_cost_beside_single_calls(merge_runner):
    run = await merge_runner(
        "sweep", "baseline", *TWO, "--model", "o3", "--batch", "--dry-run", OPENAI_API_KEY="k"
    )
    lines = run.out.splitlines()
    assert lines[5].startswith("cost    about 0.27 USD in batches; about 0.55 USD and ")
    assert lines[5].endswith(" minutes by normal requests")
    assert lines[6] == (
        "time    about 11 rounds; each takes as long as its slowest batch: minutes, hours, "
        "two days at most"
    )
