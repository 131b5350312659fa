"""Sweeps in batches that are killed, or change their mode."""

import random
import signal

import pytest

from merge_runner.results.store import results_digest
from tests.support.harness import watched
from tests.support.mock_server import BatchPlan, FaultPlan
from tests.support.priced import answered, rows

KILLS = 20
pytestmark = pytest.mark.usefixtures("priced")


async def test_a_sweep_that_is_killed_at_20_instants_pays_nothing_twice(merge_runner, tmp_path):
    """Half of the kills come when a batch is created and its id not told yet, or told and lost."""

    async def middle(request, handler):
        nonlocal passing
        passing -= 1
        creates = request.method == "POST" and request.path == "/v1/batches"
        if (creates and at == "before") or (at == "anywhere" and passing == 0):
            process.kill()
        reply = await handler(request)
        if creates and at == "after":
            process.kill()
        return reply

    study = "[repetitions]\nbaseline = 1\n[scenario]\ntimeout_s = 8\n"  # enough rounds to die in
    (tmp_path / "long.toml").write_text(study)
    sweep = ("sweep", "long.toml", "--reps", 2, "--model", "priced", "--batch", "--yes", "--json")
    chance, killed, passing = random.Random(5), 0, 0
    plan = BatchPlan(delay_s=0.5, failed=0.1, expired=0.05)
    async with watched(middle, FaultPlan(seed=3, batch=plan)) as server:
        env = server.account
        for number in range(KILLS):
            at = ("before", "after", "anywhere", "anywhere")[number % 4]
            passing = chance.randrange(1, 12)  # requests
            process = await merge_runner.start(*sweep, **env)
            killed += await process.wait() == -signal.SIGKILL
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
        plain = await merge_runner(*quiet, "--db", "quiet", "--cache", "new", **server.account)
    assert plain.code == 0, plain.err
    digest = results_digest(tmp_path / "results/merge.duckdb")
    assert digest == results_digest(tmp_path / "quiet")
    assert digest[1] == 22
    query = "select count(*) as n from calls where outcome = 'ok' and batch_id is not null"
    (used,) = await rows(merge_runner, query)
    assert used["n"] == batched.total()
