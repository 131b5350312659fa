"""A provider that is down, another model behind a name, and waits that are told."""

import json
import tomllib

import pytest
from aiohttp import web

from merge_runner.records import SLOT_HEADER
from merge_runner.results.store import query
from tests.support.harness import FAST, PROJECT, a_model, watched


def configured(folder, deadline_s, *options):
    """The baseline sweep of a copy whose model is given up soon."""
    (folder / "experiments").mkdir(exist_ok=True)
    times = {"timeout_s": 2, "deadline_s": deadline_s}
    (folder / "experiments/models.toml").write_text(a_model("patient", **times))
    (folder / "experiments/baseline.toml").write_text("[repetitions]\nbaseline = 10\n")
    return ("sweep", "baseline", "--model", "patient", "--json", *options)


class Service:
    """Answers while it works, and one call more: a run's first one, which goes alone."""

    def __init__(self, *, working):
        self.working = working
        self.one_more = True

    async def middle(self, request, handler):
        if self.working or self.one_more:
            self.one_more = self.working
            return await handler(request)
        return down()


def down():
    return web.json_response({"error": {"message": "The engine is down."}}, status=503)


async def test_one_trial_fails_with_a_reason_and_the_rest_go_on(merge_runner, tmp_path):
    async def middle(request, handler):
        slot = json.loads(request.headers[SLOT_HEADER])
        broken = slot["condition"] == "L_4_8" and slot["side"] == "left" and slot["decision"] == 2
        return down() if broken and not mended else await handler(request)

    mended = False
    sweep = configured(tmp_path, 1.2, "--reps", 1, "--conditions", "L_4_8,N_0_0,L_4_0")
    async with watched(middle) as server:
        run = await merge_runner(*sweep, code=1, **server.env)
        assert run.summary["trials"]["finished"] == 2
        ((trial, error),) = run.summary["failed"].items()
        assert trial == "patient/baseline/L_4_8/rep01"
        assert "no reply within 1 s (HTTP 503: The engine is down.), 2 attempts" in error
        before = server.requests
        mended = True
        again = await merge_runner(*sweep, code=0, **server.env)
    # The attempts in vain are not forgotten, and what had been answered was not asked again.
    told = "select fate from attempts where outcome = 'overloaded'"
    assert query(tmp_path / "results/merge.duckdb", told)[1] == [("retried",)] * 2
    assert server.requests - before < 20
    assert again.summary["trials"]["stored_before"] == 2


async def test_when_everything_fails_the_list_is_not_burnt_and_recorded_trials_do_not_hide_it(
    merge_runner, tmp_path
):
    service = Service(working=True)
    sweep = configured(tmp_path, 0.6, "--in-flight", 3, "--reps", 2)
    async with watched(service.middle) as server:
        part = ("--conditions", "L_4_0,L_4_8,N_0_0")
        assert (await merge_runner(*sweep, *part, **server.env)).code == 0
        service.working, before = False, server.requests
        run = await merge_runner(*sweep, "--db", "new", code=1, **server.env)
        said = "10 different calls to patient failed and none was answered in between"
        assert said in run.err
        assert "run the same command to go on" in run.err
        trials = run.summary["trials"]
        assert (trials["failed"] <= 13, trials["finished"] + trials["collided"] <= 6) == (
            True,
            True,
        )
        # Two sides of at most 13 of 16 trials, with two or three attempts each.
        assert server.requests - before <= 2 * 13 * 3
        service.working = True
        configured(tmp_path, 60)
        again = await merge_runner(
            *sweep, "--reps", 2, "--in-flight", 20, "--db", "new", **server.env
        )
    assert again.code == 0, again.err
    assert again.summary["trials"]["finished"] + again.summary["trials"]["collided"] == 22


STREAM = ('data: {"choices": [{"delta": {"content": "M"}}]}\n\ndata: [DONE]\n', "text/event-stream")
FIRST_CALLS = tomllib.loads((PROJECT / "tests/cases/first_calls.toml").read_text())


def as_reply(body, status=200):
    """A reply of JSON, or of a text and its type."""
    if isinstance(body, tuple):
        return web.Response(text=body[0], content_type=body[1], status=status)
    return web.json_response(body, status=status)


@pytest.mark.parametrize("case", FIRST_CALLS)
async def test_what_no_call_would_fare_better_with_ends_the_run_at_its_first_call(
    merge_runner, case
):
    told = {"status": 200, "type": "application/json", "requests": 1, **FIRST_CALLS[case]}

    async def middle(request, handler):
        return as_reply((told["body"], told["type"]), told["status"])

    sweep = ("sweep", "baseline", "--reps", 2, "--model", "o3", "--yes", "--json", *FAST)
    async with watched(middle) as server:
        env = server.account
        run = await merge_runner(*sweep, "--max-cost", 20, **env)
    assert (run.code, server.requests) == (told["exit"], told["requests"]), run.err
    last = run.err.splitlines()[-1]
    assert all(each in last for each in told["words"]), last
    assert run.summary["trials"]["failed"] == 0
    if told["status"] != 200:
        assert run.summary["set_aside_usd"] == 0


async def test_errors_within_a_200_and_odd_bodies_in_the_midst_of_a_run_cost_no_trial(
    merge_runner, tmp_path
):
    odd = [
        *({"error": {"type": f"{name}_error", "message": "m"}} for name in ("overloaded", "api")),
        *({"error": {"message": "m", "code": 529}}, {"error": "Model unloaded."}),
        *(STREAM, {"status": "up"}),
    ]

    async def middle(request, handler):
        if server.requests > 3 and odd and server.requests % 3 == 0:
            return as_reply(odd.pop())
        return await handler(request)

    sweep = configured(tmp_path, 600, "--reps", 1, "--conditions", "L_4_8,N_0_0")
    async with watched(middle) as server:
        run = await merge_runner(*sweep, **server.env)
    assert run.code == 0, run.err
    assert not odd


async def test_waits_are_told(merge_runner, tmp_path, monkeypatch):
    monkeypatch.setattr("merge_runner.llm.client.LONG_WAIT_S", 0.5)

    async def middle(request, handler):
        if server.requests > 1:
            return await handler(request)
        error = {"error": {"message": "Slow down."}}
        return web.json_response(error, status=429, headers={"retry-after": "2"})

    async with watched(middle) as server:
        sweep = configured(tmp_path, 60, "--reps", 1, "--conditions", "L_4_8")
        run = await merge_runner(*sweep, **server.env)
    assert run.code == 0
    (told,) = [text for text in run.err.splitlines() if "decision 0 waits until" in text]
    assert "L_4_8 rep 1" in told
    assert "HTTP 429" in told


async def test_another_model_behind_a_name_stops_a_strict_sweep(merge_runner):
    async def middle(request, handler):
        reply = await handler(request)
        body = json.loads(reply.body)
        if server.requests > 5:
            body["model"] = "o3-mini"
        return web.json_response(body)

    sweep = ("sweep", "baseline", "--reps", 2, "--model", "o3", "--yes", "--json", *FAST)
    async with watched(middle) as server:
        env = server.account
        run = await merge_runner(*sweep, "--in-flight", 2, "--strict-model", code=1, **env)
        assert "o3-mini answered where o3-2025-04-16 was asked for" in run.err
        stopped_at = server.requests
        assert stopped_at < 20
        # Its replies are kept: the same command stops at once, and without the option it goes on.
        await merge_runner(*sweep, "--strict-model", "--in-flight", 2, code=1, **env)
        loose = await merge_runner(*sweep, "--conditions", "L_4_0", code=0, **env)
    assert loose.summary["model_mismatches"]
