"""Sweeps as a user runs them, over real HTTP against the emulator."""

from __future__ import annotations

import asyncio
import fcntl
import json
import os
import signal
import termios

import pytest
from aiohttp import web

from merge_runner.records import SLOT_HEADER
from merge_runner.results.store import query, results_digest
from tests.support.gate import HANGS_S, Gate
from tests.support.harness import FAST, PROGRAM, environment, watched
from tests.support.mock_server import TRANSIENT, FaultPlan

SMALL = ("sweep", "baseline", "--reps", 1, "--json")
TWO = ("--conditions", "N_0_0,L_4_8")
DB = "results/merge.duckdb"


async def test_a_sweep_stores_every_trial_and_prints_outcomes_and_the_database(merge_runner):
    run = await merge_runner("sweep", "baseline", "--reps", 1)
    assert run.code == 0, run.err
    lines = run.out.splitlines()
    head = "condition trials left first right first collided timeout failed"
    assert lines[0].split() == head.split()
    assert [line.split()[1] for line in lines[1:13]] == ["1"] * 11 + ["11"]
    assert "database: results/merge.duckdb" in lines
    assert "scripted stand-in" in run.out
    assert "11/11 ended" in run.err


async def test_several_sweeps_are_played_one_after_the_other(merge_runner):
    names = ("baseline", "ablations", "--variants", "baseline", "--reps", 1, "--json")
    run = await merge_runner("sweep", *names, "--conditions", "L_4_8")
    assert run.code == 0, run.err
    summaries = [json.loads(line) for line in run.out.splitlines()]
    assert [each["trials"]["stored_before"] for each in summaries] == [0, 1]
    again = await merge_runner("replay", *names, "--conditions", "L_4_8", "--db", "replayed.duckdb")
    assert (again.code, len(again.out.splitlines())) == (0, 2), again.err


async def test_of_several_sweeps_all_are_looked_at_before_the_first_is_played(merge_runner):
    run = await merge_runner("sweep", "baseline", "ablation", "--reps", 1)
    assert (run.code, run.out) == (2, "")
    assert "ablations" in run.err
    apart = await merge_runner("sweep", "one/study.toml", "two/study.toml")
    assert (apart.code, "--db and --cache" in apart.err) == (2, True)


async def test_what_is_recorded_is_not_asked_again_and_what_is_new_is(merge_runner, tmp_path):
    async with watched() as server:
        env = {"EMULATOR_BASE_URL": f"{server.url}/v1"}
        first = (await merge_runner(*SMALL, *TWO, **env)).summary
        asked_first = server.requests
        again = (*SMALL, *TWO, "--reps", 2)
        second = (await merge_runner(*again, **env)).summary
        new = server.requests - asked_first
        (tmp_path / "results/merge.duckdb").unlink()
        third = (await merge_runner(*again, **env)).summary
        assert first["calls"] == {"live": asked_first, "cached": 0}
        assert second["calls"] == {"live": new, "cached": 0}
        assert second["trials"]["stored_before"] == 2
        assert third["calls"] == {"live": 0, "cached": asked_first + new}
        assert set(server.asked.values()) == {1}
    assert third["trials"]["finished"] + third["trials"]["collided"] == 4


async def test_the_digest_depends_on_no_schedule_and_no_transient_fault(merge_runner, tmp_path):
    # Of each transient fault a fiftieth; a hang ends soon, without a reply.
    faulty = FaultPlan(seed=5, hang_s=0.1, rates=dict.fromkeys(TRANSIENT, 0.02))
    for name, in_flight, plan in (("one", 1, None), ("faults", 200, faulty)):
        places = ("--db", f"{name}.duckdb", "--cache", name, "--in-flight", in_flight)
        async with watched(faults=plan) as server:
            env = {"EMULATOR_BASE_URL": f"{server.url}/v1"}
            run = await merge_runner(*SMALL, *TWO, *places, **env)
        assert run.code == 0, run.err
        assert run.summary["trials"]["failed"] == 0
    faults = sum(n for outcome, n in run.summary["attempts"].items() if outcome != "ok")
    assert faults > 3, "hardly a fault was injected"
    digests = [results_digest(tmp_path / f"{name}.duckdb") for name in ("one", "faults")]
    assert digests[0] == digests[1]
    assert digests[0][1] == 2


async def test_another_sample_set_and_another_prompt_are_other_samples(merge_runner, tmp_path):
    for more in ((), ("--sample-set", 1), ("--variants", "A1")):
        run = await merge_runner(*SMALL, "--conditions", "L_4_8", *more)
        assert run.summary["calls"]["cached"] == 0 < run.summary["calls"]["live"]
    trials = query(tmp_path / DB, "select trial_id from trials order by all")[1]
    assert [trial for (trial,) in trials] == [
        "emulator/A1/L_4_8/rep01",
        "emulator/baseline/L_4_8/rep01",
        "emulator/baseline/L_4_8/rep01/set1",
    ]


async def test_a_stub_never_answers_for_the_endpoint_nor_another_model_in_silence(merge_runner):
    async def middle(request, handler):
        body = json.loads((await handler(request)).body)
        return web.json_response(body | {"model": "gpt-4o"})

    async with watched() as one, watched(middle) as other:
        for server, other_models in ((one, 0), (other, 1)):
            env = {"OPENAI_API_KEY": "k", "OPENAI_BASE_URL": f"{server.url}/v1"}
            sweep = (*SMALL[:-1], "--conditions", "L_4_0", "--model", "o3", "--yes", *FAST)
            run = await merge_runner(*sweep, **env)
            assert (run.code, run.out.count("another model answered")) == (0, other_models)
        assert one.requests == other.requests > 0
    ambiguous = await merge_runner("replay", "baseline", "--reps", 1, "--model", "o3")
    assert ambiguous.code == 2
    assert one.url in ambiguous.err


async def test_a_failed_trial_is_a_row_and_the_same_command_plays_it_anew(merge_runner):
    broken = True

    async def middle(request, handler):
        slot = json.loads(request.headers[SLOT_HEADER])
        if broken and slot["condition"] == "N_0_0" and slot["decision"] == 3:
            return web.json_response({"error": {"message": "No such thing."}}, status=400)
        return await handler(request)

    async with watched(middle) as server:
        env = {"EMULATOR_BASE_URL": f"{server.url}/v1"}
        run = await merge_runner(*SMALL, *TWO, **env)
        assert run.code == 1
        assert run.summary["trials"]["failed"] == 1
        assert run.summary["trials"]["finished"] + run.summary["trials"]["collided"] == 1
        assert "No such thing." in run.summary["failed"]["emulator/baseline/N_0_0/rep01"]
        calls = await merge_runner("sql", "select outcome, count(*) n from calls group by all")
        assert "bad_request" in calls.out
        broken = False
        again = await merge_runner(*SMALL, *TWO, **env)
        assert again.code == 0, again.err
        answered = {k: n for k, n in server.asked.items() if n > 1}
        assert len(answered) == 2, "only the two rejected calls were asked again"
    rows = await merge_runner("sql", "select count(*) n from trials", "--format", "json")
    assert json.loads(rows.out) == [{"n": 2}]


async def test_an_account_problem_stops_the_sweep_and_it_goes_on_later(merge_runner):
    allowed, refusal = 30, None

    async def middle(request, handler):
        nonlocal allowed
        allowed -= 1
        if allowed < 0:
            status, reason = refusal
            error = {"message": "no more", "type": reason, "code": reason}
            return web.json_response({"error": error}, status=status)
        return await handler(request)

    async with watched(middle) as server:
        sweep = (*SMALL, *TWO, "--in-flight", 1)
        for problem, code, says in (
            ((429, "insufficient_quota"), 3, "quota"),
            ((401, "invalid_api_key"), 2, "key"),
            ((404, "model_not_found"), 2, "model"),
        ):
            refusal = problem
            asked = server.requests + max(allowed, 0)
            run = await merge_runner(*sweep, EMULATOR_BASE_URL=f"{server.url}/v1")
            assert run.code == code
            assert says in run.summary["messages"][0]
            assert server.requests <= asked + 2, "it went on asking"
        allowed = 10_000
        assert (await merge_runner(*sweep, EMULATOR_BASE_URL=f"{server.url}/v1")).code == 0
        # Each answered call was asked once; those refused at the stops, once more each time.
        assert sum(n > 1 for n in server.asked.values()) <= 2


async def test_ctrl_c_saves_what_is_in_flight_and_the_same_command_goes_on(
    merge_runner, tmp_path, quiet
):
    gate = Gate(60, tmp_path)
    async with watched(gate.middle) as server, asyncio.timeout(HANGS_S):
        env = {"EMULATOR_BASE_URL": f"{server.url}/v1"}
        process = await merge_runner.start(*SMALL, **env)
        await gate.quiet(tmp_path / "cache/responses", trials=4)
        process.send_signal(signal.SIGINT)
        process.send_signal(signal.SIGTERM)  # both at once end it as one does
        await process.said("calls in flight")
        gate.open()
        out, err = await process.communicate()
        assert process.returncode == 130, err
        assert "Run the same command again" in json.loads(out)["messages"][0]
        assert b"Traceback" not in err
        again = await merge_runner(*SMALL, **env)
        assert again.code == 0
        assert not gate.asked_again
    assert results_digest(tmp_path / DB) == quiet


def of_a_terminal():
    """Make a process one of its terminal, whose closing it is told, also where nohup ignores it."""
    signal.signal(signal.SIGHUP, signal.SIG_DFL)
    fcntl.ioctl(0, termios.TIOCSCTTY, 0)


async def test_a_terminal_that_closes_loses_no_call_that_is_in_flight(
    merge_runner, tmp_path, quiet
):
    gate = Gate(40, tmp_path)
    ours, theirs = os.openpty()
    async with watched(gate.middle) as server, asyncio.timeout(HANGS_S):
        env = {"EMULATOR_BASE_URL": f"{server.url}/v1"}
        process = await asyncio.create_subprocess_exec(
            PROGRAM,
            *map(str, SMALL),
            cwd=tmp_path,
            env=environment(**env),
            stdin=theirs,
            stdout=theirs,
            stderr=theirs,
            start_new_session=True,
            preexec_fn=of_a_terminal,
        )
        os.close(theirs)
        asyncio.get_running_loop().add_reader(ours, os.read, ours, 2**16)
        await gate.quiet(tmp_path / "cache/responses", trials=4)
        asyncio.get_running_loop().remove_reader(ours)
        os.close(ours)
        # As the shell does, and the service that ends what a login has left.
        process.send_signal(signal.SIGHUP)
        process.send_signal(signal.SIGTERM)
        gate.open()
        assert await process.wait() == 130
        again = await merge_runner(*SMALL, **env)
        assert again.code == 0, again.err
        assert not gate.asked_again
    assert results_digest(tmp_path / DB) == quiet


async def test_another_process_queries_while_a_sweep_runs(merge_runner, tmp_path):
    gate = Gate(120, tmp_path)  # of two trials at a time, of up to 40 calls each
    async with watched(gate.middle) as server, asyncio.timeout(HANGS_S):
        sweep = (*SMALL, "--in-flight", 2)
        process = await merge_runner.start(*sweep, EMULATOR_BASE_URL=f"{server.url}/v1")
        seen = 0
        while not seen:
            query = await merge_runner("sql", "select count(*) n from trials", "--format", "json")
            if query.code == 0:  # before the sweep has made the database it is 2
                seen = json.loads(query.out)[0]["n"]
        assert process.returncode is None
        gate.open()
        assert await process.wait() == 0
    assert seen < 11


async def test_programs_drive_without_a_call_alone_and_against_a_model(merge_runner):
    for program, ends in (("constant", "collided"), ("projected-order", "finished")):
        alone = await merge_runner(*SMALL, "--model", program, "--in-flight", 10**9)
        assert alone.summary["trials"][ends] == 11
        assert alone.summary["calls"] == {"live": 0, "cached": 0}
    mixed = await merge_runner(*SMALL, "--conditions", "N_0_0", "--model", "emulator+constant")
    assert mixed.code == 0
    rows = await merge_runner(
        "sql",
        "select distinct model_left, model_right, side, call_key is null as program "
        "from decisions join trials using (trial_id, spec_hash) where source = 'llm' order by all",
        "--format", "csv",
    )  # fmt: skip
    assert rows.out.split()[1:] == ["emulator,constant,left,False", "emulator,constant,right,True"]


async def test_a_dry_run_tells_and_touches_nothing(merge_runner, tmp_path):
    run = await merge_runner("sweep", "ablations", "--model", "o3", "--dry-run", "--json")
    assert run.code == 0
    assert run.summary["trials"] == 495
    assert run.summary["calls"] == pytest.approx(495 * 21, rel=0.01)
    assert run.summary["cost_usd"] > 50
    assert list(tmp_path.iterdir()) == []


async def test_a_dry_run_counts_the_trials_of_programs_that_are_not_stored(merge_runner):
    part = ("sweep", "baseline", "--model", "idm", "--model", "idm+constant", "--reps", 2)
    await merge_runner(*part, "--conditions", "N_0_0")
    for trials, db in ((44, ("--db", "none")), (40, ())):
        told = await merge_runner(*part, "--dry-run", "--json", *db)
        assert (told.summary["trials"], told.summary["calls"]) == (trials, 0)
