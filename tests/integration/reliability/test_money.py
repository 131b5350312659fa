"""What is spent is known and bounded, over all runs of a sweep, also where a process dies."""

import asyncio
import json
import re
import shutil

import pytest
from aiohttp import web

from tests.support.harness import FAST, PROJECT, a_model, as_a_model, watched
from tests.support.priced import rows

SWEEP = ("sweep", "baseline", "--conditions", "L_4_0,N_0_0,R_-4_8", "--model", "o3", "--json")
# o3 at 2 and 8 USD per million tokens: a trial of the emulator costs about 0.08 USD, and each of
# its up to 24 calls could cost 0.14 USD (16,000 tokens of output).
SHORT = "[repetitions]\nbaseline = 4\n[scenario]\ntimeout_s = 12\n"
ROOM_FOR_SOME = 0.9
ONE = (*SWEEP, "--reps", 1, "--conditions", "L_4_0", "--yes", *FAST)
O3 = {"provider": "openai", "max_output_tokens": 16_000}


@pytest.fixture(autouse=True)
def experiments(tmp_path):
    """Trials that end after 12 s at the latest."""
    folder = tmp_path / "experiments"
    shutil.copytree(PROJECT / "experiments", folder)
    (folder / "baseline.toml").write_text(SHORT)
    return folder


class Bill:
    """What the server charges: the price of every answer that it counts."""

    def __init__(self):
        self.usd = 0.0

    async def middle(self, request, handler):
        reply = await handler(request)
        usage = json.loads(reply.body)["usage"]
        self.usd += (2 * usage["prompt_tokens"] + 8 * usage["completion_tokens"]) / 1e6
        return reply


async def test_the_cap_holds_over_all_runs_and_a_higher_one_goes_on(merge_runner):
    bill = Bill()
    async with watched(bill.middle) as server:
        env = server.account
        sweep = (*SWEEP, "--reps", 4, "--yes", *FAST)
        run = await merge_runner(*sweep, "--max-cost", ROOM_FOR_SOME, code=3, **env)
        assert 0 < bill.usd <= ROOM_FOR_SOME
        assert run.summary["cost_usd"] == pytest.approx(bill.usd)
        assert run.summary["trials"]["suspended"] > 0
        assert f"{bill.usd:.2f} of {ROOM_FOR_SOME} over all runs" in run.err.splitlines()[-2]
        assert "raise --max-cost, and run the same command" in run.err
        # What is finished is balanced: no condition is far ahead of another one.
        query = "select condition, count(*) as n from trials group by all order by n"
        counts = await rows(merge_runner, query)
        assert len(counts) == 3
        assert counts[-1]["n"] - counts[0]["n"] <= 2
        spent = bill.usd
        # The same cap again: nothing is left to begin a trial with.
        again = await merge_runner(*sweep, "--max-cost", ROOM_FOR_SOME, **env)
        assert (again.code, bill.usd) == (3, spent)
        assert again.summary["sweep_cost_usd"] == pytest.approx(spent)
        done = await merge_runner(*sweep, "--max-cost", 50, code=0, **env)
        (calls,) = await rows(merge_runner, "select count(*) as n from calls")
        assert calls["n"] == server.requests, "nothing was paid for twice"
        query = "select (config->>'max_cost_usd')::double as cap from sweeps order by started_at"
        caps = [row["cap"] for row in await rows(merge_runner, query)]
        assert caps == [ROOM_FOR_SOME, ROOM_FOR_SOME, 50]
    assert done.summary["sweep_cost_usd"] == pytest.approx(bill.usd)
    assert done.summary["set_aside_usd"] == 0
    for query in (
        "select sum(cost_usd) as usd from trial_costs",
        "select cost_usd as usd from sweep_costs order by sweep_id desc limit 1",
    ):
        assert await rows(merge_runner, query) == [{"usd": pytest.approx(bill.usd)}]


async def test_one_cap_holds_over_several_sweeps(merge_runner, experiments):
    (experiments / "baseline.toml").write_text(SHORT.replace("4", "1"))
    (experiments / "other.toml").write_text(SHORT.replace("baseline", "A1"))
    bill = Bill()
    async with watched(bill.middle) as server:
        sweep = ("sweep", "baseline", "other", *SWEEP[2:], "--yes", *FAST)
        run = await merge_runner(*sweep, "--max-cost", ROOM_FOR_SOME, **server.account)
    first, other = (json.loads(line) for line in run.out.splitlines())
    assert (run.code, first["trials"]["suspended"]) == (3, 0), run.err
    assert other["trials"]["suspended"] > 0
    assert other["sweep_cost_usd"] < bill.usd <= ROOM_FOR_SOME
    told = "USD of baseline/o3/set0 count against the budget, too"
    assert told in run.err
    dry = await merge_runner(*sweep, "--max-cost", ROOM_FOR_SOME, "--dry-run")
    assert told in dry.err
    rest = json.loads(dry.out.splitlines()[-1])
    assert rest["left_usd"] == pytest.approx(ROOM_FOR_SOME - bill.usd)


async def test_a_begun_trial_that_cannot_be_paid_is_suspended_with_its_replies(merge_runner):
    async def middle(request, handler):
        body = json.loads((await handler(request)).body)
        # Every answer costs as much as it can, and three are cut, at an unknown cost.
        body["usage"]["completion_tokens"] = 16_000
        if server.requests in (3, 6, 9):
            raise web.HTTPOk(text='{"cut')
        return web.json_response(body)

    async with watched(middle) as server:
        env = server.account
        run = await merge_runner(*ONE, "--max-cost", 2.5, code=3, **env)
        assert run.summary["trials"]["suspended"] == 1
        assert run.summary["sweep_cost_usd"] + run.summary["set_aside_usd"] <= 2.5
        assert run.summary["set_aside_usd"] > 0.1
        first = server.requests
        assert first > 15
        done = await merge_runner(*ONE, "--max-cost", 30, **env)
    assert done.code == 0, done.err
    assert done.summary["calls"]["cached"] >= first - run.summary["attempts_of_unknown_cost"] - 1


async def test_what_a_run_has_in_flight_is_not_released_and_stays_set_aside_when_it_is_killed(
    merge_runner,
):
    async def middle(request, handler):
        if 1 < server.requests <= 4:  # the first one goes alone
            if server.requests == 4:
                arrived.set()
            await asyncio.Event().wait()
        return await handler(request)

    arrived = asyncio.Event()
    sweep = (*SWEEP, "--reps", 2, "--conditions", "L_4_0", "--yes", *FAST)
    async with watched(middle) as server:
        env = server.account
        process = await merge_runner.start(*sweep, **env)
        await arrived.wait()
        told = await merge_runner("ledger")
        refused = await merge_runner("ledger", "--release", "baseline/o3/set0", "--yes")
        process.kill()
        await process.wait()
        gone = await merge_runner("ledger")
        run = await merge_runner(*sweep, **env)
    assert run.code == 0, run.err
    assert "  in flight  3  " in told.out
    assert "  in flight when its process ended  3  " in gone.out
    assert refused.code == 2
    assert "another merge-runner works with" in refused.err
    assert run.summary["attempts_of_unknown_cost"] == 3
    assert 0.38 < run.summary["set_aside_usd"] < 0.45
    query = "select fate, cached from attempts where outcome = 'unknown'"
    assert await rows(merge_runner, query) == [{"fate": "retried", "cached": True}] * 3


async def test_hits_cost_nothing_and_the_estimate_counts_what_is_missing(merge_runner, tmp_path):
    async with watched(as_a_model, honest=False) as server:
        env = server.account
        sweep = (*SWEEP, "--conditions", "L_4_0", *FAST, "--reps")
        before = sorted(tmp_path.rglob("*"))
        assert not (await merge_runner(*sweep, 1, "--dry-run", **env)).summary["measured"]
        assert sorted(tmp_path.rglob("*")) == before, "a dry run makes no file"
        first = await merge_runner(*sweep, 1, "--yes", **env)
        dry = (await merge_runner(*sweep, 2, "--dry-run", **env)).summary
        assert (dry["trials"], dry["calls"], dry["measured"]) == (1, 21, True)
        per_call = first.summary["cost_usd"] / first.summary["calls"]["live"]
        assert dry["cost_usd"] == pytest.approx(dry["calls"] * per_call, abs=0.005)
        text = [word for word in sweep if word != "--json"]
        second = await merge_runner(*text, 2, "--yes", **env)
        assert "estimated before: " in second.out
        requests = server.requests
        for db in (
            (),
            ("--db", "new"),
        ):  # nothing is left to ask, so that it does not ask for --yes
            again = await merge_runner(*sweep, 2, *db, **env)
            assert (again.code, server.requests) == (0, requests), again.err
        replay = await merge_runner("replay", *sweep[1:], 2, "--db", "other", **env)
    assert replay.summary["cost_usd"] == replay.summary["calls"]["live"] == 0
    (calls,) = await rows(merge_runner, "select count(*) as n from calls")
    assert calls["n"] == server.requests
    (paid,) = await rows(merge_runner, "select sum(paid_usd) as usd from trial_costs")
    assert paid["usd"] > 0
    other = await merge_runner("sql", "select sum(paid_usd) from trial_costs", "--db", "other")
    assert other.out.split()[-1] == "0.0"


async def test_an_unknown_price_is_said_and_needs_yes(merge_runner, experiments):
    entry = a_model("mine", **O3, id="nobody-knows", price="genai-prices")
    (experiments / "models.toml").write_text(entry)
    async with watched() as server:
        env = server.account
        sweep = ("sweep", "baseline", "--model", "mine", "--conditions", "L_4_0", "--json", *FAST)
        asked = await merge_runner(*sweep, code=2, **env)
        assert "an unknown price" in asked.err
        assert "--yes" in asked.err
        capped = await merge_runner(*sweep, "--yes", "--max-cost", 1, code=2, **env)
        assert "--max-cost cannot hold" in capped.err
        assert "give it a `price` in [mine] in experiments/models.toml" in capped.err
        baseline = experiments / "baseline.toml"
        study = baseline.read_text()
        baseline.write_text(f"[budget]\ntotal_usd = 0.4\n{study}")
        capped = await merge_runner(*sweep, "--yes", code=2, **env)
        assert "so [budget] of baseline cannot hold" in capped.err
        baseline.write_text(study)
        assert server.requests == 0
        run = await merge_runner(*sweep, "--yes", **env)
    assert run.code == 0, run.err
    assert run.summary["calls_of_unknown_cost"] == server.requests


async def test_runs_of_two_models_under_one_cap_never_pass_it_and_both_end(
    merge_runner, experiments
):
    (experiments / "baseline.toml").write_text(f"[budget]\ntotal_usd = 0.4\n{SHORT}")
    with (experiments / "models.toml").open("a") as registry:
        price = {"input": 2.0, "output": 8.0, "source": "here"}
        registry.write("\n" + a_model("twin", **O3, id="o3-twin", price=price))
    bill = Bill()
    async with watched(bill.middle) as server:
        env = server.account
        sweep = ("sweep", "baseline", "--conditions", "L_4_0,N_0_0,R_-4_8", "--reps", 1, "--yes")
        twins = ("o3", "twin")
        runs = [await merge_runner.start(*sweep, *FAST, "--model", name, **env) for name in twins]
        codes = [await run.wait() for run in runs]
    assert {*codes} <= {0, 3}
    assert 0 < bill.usd <= 0.4
    (calls,) = await rows(merge_runner, "select count(distinct call_key) as n from calls")
    assert calls["n"] <= server.requests


async def test_what_is_set_aside_is_shown_with_its_reasons_and_released_by_name(
    merge_runner, tmp_path
):
    async def middle(request, handler):
        if server.requests in (3, 5):
            return web.Response(status=502, text="<html>502 Bad Gateway</html>")
        return await handler(request)

    async with watched(middle) as server:
        assert (await merge_runner(*ONE, **server.account)).code == 0
    cache = tmp_path / "cache/responses"
    (cache / "live.lock").unlink()
    before = {path.name: path.read_bytes() for path in cache.iterdir()}
    told = await merge_runner("ledger")
    assert {path.name: path.read_bytes() for path in cache.iterdir()} == before
    driver = f"o3 at {server.url.removeprefix('http://')}"
    assert re.match(
        r"sweep +spent_usd +reserved_usd +attempts of unknown cost\n"
        r"baseline/o3/set0  0\.\d+ +0\.\d+ +2\n",
        told.out,
    ), told.out
    assert f"\nbaseline/o3/set0  {driver}  server_error  2         0." in told.out
    assert "  L_4_0 rep 1 " in told.out
    (account_before,) = json.loads((await merge_runner("ledger", "--json")).out)
    assert account_before["open_attempts"] == account_before["reasons"][0]["attempts"] == 2
    asked = await merge_runner("ledger", "--release", "baseline/o3/set0", code=2)
    assert "a cap may be passed by as much" in asked.err
    assert "add --yes" in asked.err
    unknown = await merge_runner("ledger", "--release", "other/o3/set0", "--yes")
    assert (unknown.code, "valid: baseline/o3/set0" in unknown.err) == (2, True)
    released = await merge_runner("ledger", "--release", "baseline/o3/set0", "--yes", "--json")
    (after,) = json.loads(released.out)
    assert (after["reserved_usd"], after["open_attempts"]) == (0, 0)
    assert after["spent_usd"] == account_before["spent_usd"]
    shown = await merge_runner("ledger")
    assert "server_error" not in shown.out
    assert shown.out.split("\n")[0].split() == ["sweep", "spent_usd"]


async def test_a_cap_ends_a_study_whose_trials_share_their_calls(merge_runner, tmp_path):
    await merge_runner("init", tmp_path / "study")
    study = tmp_path / "study" / "study.toml"
    study.write_text(study.read_text().replace('["emulator"]', '["emulator-priced"]'))
    run = await merge_runner("sweep", study, "--max-cost", 0.5, "--yes", "--trust", "--json")
    assert run.code == 3, run.err
    assert run.summary["trials"]["suspended"] > 0
    assert 0.3 < run.summary["cost_usd"] <= 0.5
