"""Sweeps as a user runs them, over real HTTP against the emulator."""

import asyncio
import fcntl
import json
import os
import re
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
PAIR = ("baseline", "--model", "projected-order+emulator", "--model", "constant", "--mirror",
        "--reps", 1, "--conditions", "N_0_0,L_4_0,R_-4_8")  # fmt: skip


async def test_a_sweep_stores_every_trial_and_its_summary_is_five_lines(merge_runner):
    run = await merge_runner("sweep", "--reps", 1, code=0)
    trials, decisions, calls, who, checked = run.out.splitlines()
    ways = re.fullmatch(
        r"trials: 11 \((\d+) left first, (\d+) right first(?:, (\d) collided)?\)", trials
    )
    assert sum(map(int, filter(None, ways.groups()))) == 11
    assert re.fullmatch(r"decisions: (\d+), 0 invalid, 0 fallbacks", decisions)
    assert re.fullmatch(r"calls: \d+ asked; cost 0.0000 USD", calls)
    assert who == "The model `emulator` is a mock model, no language model."
    assert checked == "checked: no problems; database: results/merge.duckdb"
    assert run.err.splitlines()[-1].startswith("trials: 11/11 ended; ")
    assert run.err.count("trials: 11/11 ended") == 1
    named = await merge_runner(
        "sweep", "--reps", 2, "--conditions", "L_4_0", "--name", "the second"
    )
    assert named.out.splitlines()[:2] == [
        "run: the second",
        "trials: 2 (2 left first), 1 of them stored before this run",
    ]
    runs = "select config->>'run_name' as name from sweeps order by started_at"
    assert (await merge_runner("sql", runs)).out.split(maxsplit=1)[1].strip() == "the second"
    again = await merge_runner("replay", "--reps", 1, "--conditions", "L_4_0", "--db", "again")
    assert re.search(r"^calls: \d+ from the cache; cost 0.0000 USD$", again.out, re.MULTILINE)


async def test_an_estimate_assumes_no_more_tokens_than_a_reply_may_have(merge_runner, tmp_path):
    text = 'models = ["gpt-6-sol"]\nrepetitions = 1\n[factors]\nmax_output_tokens = [500]\n'
    (tmp_path / "short.toml").write_text(text)
    told = await merge_runner("sweep", "short.toml", "--dry-run")
    calls = int(re.search(r"calls   about (\d+)", told.out)[1])
    assert f", {500 * calls} out\n" in told.out
    assert "a reply is cut off at 500 output tokens (max_output_tokens)\n" in told.out


async def test_several_sweeps_are_all_looked_at_and_played_one_after_the_other(merge_runner):
    names = ("baseline", "ablations", "--variants", "baseline", "--reps", 1, "--json")
    run = await merge_runner("sweep", *names, "--conditions", "L_4_8", code=0)
    summaries = [json.loads(line) for line in run.out.splitlines()]
    assert [each["trials"]["stored_before"] for each in summaries] == [0, 1]
    again = await merge_runner("replay", *names, "--conditions", "L_4_8", "--db", "replayed.duckdb")
    assert (again.code, len(again.out.splitlines())) == (0, 2), again.err
    for wrong, said in (
        (("baseline", "ablation"), "ablations"),
        (("one/study.toml", "two/study.toml"), "--db and --cache"),
    ):
        run = await merge_runner("sweep", *wrong, "--reps", 1)
        assert (run.code, run.out, said in run.err) == (2, "", True)


async def test_what_is_recorded_is_not_asked_again_and_what_is_new_or_has_failed_is(
    merge_runner, tmp_path
):
    broken = True

    async def middle(request, handler):
        slot = json.loads(request.headers[SLOT_HEADER])
        if broken and slot["condition"] == "N_0_0" and slot["decision"] == 3:
            return web.json_response({"error": {"message": "No such thing."}}, status=400)
        return await handler(request)

    async with watched(middle) as server:
        sweep = (*SMALL, *TWO)
        run = await merge_runner(*sweep, **server.env)
        first, asked_first = run.summary, server.requests
        assert (run.code, first["trials"]["failed"]) == (1, 1)
        assert first["trials"]["finished"] + first["trials"]["collided"] == 1
        assert "No such thing." in first["failed"]["emulator/baseline/N_0_0/rep01"]
        calls = query(tmp_path / DB, "select outcome, count(*) n from calls group by all")[1]
        assert dict(calls)["bad_request"] == 2
        export = await merge_runner("recording", "export", "part.parquet")
        assert "their digest (that of a replay may differ: a run had problems): " in export.err
        broken = False
        second = (await merge_runner(*sweep, "--reps", 2, **server.env)).summary
        new = server.requests - asked_first
        assert second["calls"] == {"live": new, "cached": 6}, "those before the rejected ones"
        assert second["trials"]["stored_before"] == 1
        again = sorted(server.asked.values())
        assert again[-3:] == [1, 2, 2], "only the two rejected calls were asked again"
        for variant in (("--sample-set", 1), ("--variants", "A1")):
            other = (
                await merge_runner(*SMALL, "--conditions", "L_4_8", *variant, **server.env)
            ).summary
            assert other["calls"]["cached"] == 0 < other["calls"]["live"]
        names = [name for (name,) in query(tmp_path / DB, "select trial_id from trials")[1]]
        assert set(names) > {"emulator/A1/L_4_8/rep01", "emulator/baseline/L_4_8/rep01/set1"}
        assert len(names) == 6
        (tmp_path / DB).unlink()
        third = (await merge_runner(*sweep, "--reps", 2, **server.env)).summary
        assert third["calls"] == {"live": 0, "cached": asked_first + new - 2}
    assert third["trials"]["finished"] + third["trials"]["collided"] == 4


async def test_the_digest_depends_on_no_schedule_and_no_transient_fault(merge_runner, tmp_path):
    # Of each transient fault a fiftieth; a hang ends soon, without a reply.
    faulty = FaultPlan(seed=5, hang_s=0.1, rates=dict.fromkeys(TRANSIENT, 0.02))
    for name, in_flight, plan in (("one", 1, None), ("faults", 200, faulty)):
        places = ("--db", f"{name}.duckdb", "--cache", name, "--in-flight", in_flight)
        async with watched(faults=plan) as server:
            run = await merge_runner(*SMALL, *TWO, *places, **server.env)
        assert run.code == 0, run.err
        assert run.summary["trials"]["failed"] == 0
    faults = sum(n for outcome, n in run.summary["attempts"].items() if outcome != "ok")
    assert faults > 3, "hardly a fault was injected"
    digests = [results_digest(tmp_path / f"{name}.duckdb") for name in ("one", "faults")]
    assert digests[0] == digests[1]
    assert digests[0][1] == 2


async def test_a_stub_never_answers_for_the_endpoint_nor_another_model_in_silence(merge_runner):
    async def middle(request, handler):
        body = json.loads((await handler(request)).body)
        return web.json_response(body | {"model": "gpt-4o"})

    async with watched() as one, watched(middle) as other:
        for server, other_models in ((one, 0), (other, 1)):
            sweep = (*SMALL[:-1], "--conditions", "L_4_0", "--model", "o3", "--yes", *FAST)
            run = await merge_runner(*sweep, **server.account)
            assert (run.code, run.out.count("another model answered")) == (0, other_models)
        assert one.requests == other.requests > 0
    ambiguous = await merge_runner("replay", "baseline", "--reps", 1, "--model", "o3", code=2)
    assert one.url in ambiguous.err


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
            run = await merge_runner(*sweep, **server.env)
            assert (run.code, run.summary["trials"]["failed"]) == (code, 0)
            assert says in run.summary["messages"][0]
            assert server.requests <= asked + 2, "it went on asking"
        allowed = 10_000
        assert (await merge_runner(*sweep, **server.env)).code == 0
        # Each answered call was asked once; those refused at the stops, once more each time.
        assert sum(n > 1 for n in server.asked.values()) <= 2


async def test_ctrl_c_saves_what_is_in_flight_and_the_same_command_goes_on(
    merge_runner, tmp_path, quiet
):
    gate = Gate(60, tmp_path)
    async with watched(gate.middle) as server, asyncio.timeout(HANGS_S):
        process = await merge_runner.start(*SMALL, **server.env)
        await gate.held_trials(tmp_path / "cache/responses", trials=4)
        process.send_signal(signal.SIGINT)
        process.send_signal(signal.SIGTERM)  # both at once end it as one does
        await process.said("calls in flight")
        gate.open()
        out, err = await process.communicate()
        assert process.returncode == 130, err
        assert "Run the same command again" in json.loads(out)["messages"][0]
        assert b"Traceback" not in err
        await merge_runner(*SMALL, code=0, **server.env)
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
        process = await asyncio.create_subprocess_exec(
            PROGRAM, *map(str, SMALL), cwd=tmp_path, env=environment(**server.env),
            stdin=theirs, stdout=theirs, stderr=theirs,
            start_new_session=True, preexec_fn=of_a_terminal,
        )  # fmt: skip
        os.close(theirs)
        asyncio.get_running_loop().add_reader(ours, os.read, ours, 2**16)
        await gate.held_trials(tmp_path / "cache/responses", trials=4)
        asyncio.get_running_loop().remove_reader(ours)
        os.close(ours)
        # As the shell does, and the service that ends what a login has left.
        process.send_signal(signal.SIGHUP)
        process.send_signal(signal.SIGTERM)
        gate.open()
        assert await process.wait() == 130
        await merge_runner(*SMALL, code=0, **server.env)
        assert not gate.asked_again
    assert results_digest(tmp_path / DB) == quiet


async def test_another_process_queries_while_a_sweep_runs(merge_runner, tmp_path):
    gate = Gate(120, tmp_path)  # of two trials at a time, of up to 40 calls each
    async with watched(gate.middle) as server, asyncio.timeout(HANGS_S):
        sweep = (*SMALL, "--in-flight", 2)
        process = await merge_runner.start(*sweep, **server.env)
        seen = 0
        while not seen:
            asked = await merge_runner("sql", "select count(*) n from trials", "--format", "json")
            if asked.code == 0:  # before the sweep has made the database it is 2
                seen = json.loads(asked.out)[0]["n"]
        assert process.returncode is None
        gate.open()
        assert await process.wait() == 0
    assert seen < 11


async def test_programs_drive_without_a_call_alone_and_against_a_model(merge_runner, tmp_path):
    for program, ends in (("constant", "collided"), ("projected-order", "finished")):
        alone = await merge_runner(*SMALL, "--model", program, "--in-flight", 10**9)
        assert alone.summary["trials"][ends] == 11
        assert alone.summary["calls"] == {"live": 0, "cached": 0}
    await merge_runner(*SMALL, "--conditions", "N_0_0", "--model", "emulator+constant", code=0)
    sql = (
        "select distinct model_left, model_right, side, call_key is null from decisions "
        "join trials using (trial_id, spec_hash) where source = 'llm' order by all"
    )
    pair = ("emulator", "constant")
    assert query(tmp_path / DB, sql)[1] == [(*pair, "left", False), (*pair, "right", True)]


async def test_a_dry_run_tells_and_touches_nothing_and_counts_trials_that_are_not_stored(
    merge_runner, tmp_path
):
    run = await merge_runner("sweep", "ablations", "--model", "o3", "--dry-run", "--json")
    assert (run.code, run.summary["trials"]) == (0, 495)
    assert run.summary["calls"] == pytest.approx(495 * 21, rel=0.01)
    assert run.summary["cost_usd"] > 50
    assert list(tmp_path.iterdir()) == []
    part = ("sweep", "baseline", "--model", "idm", "--model", "idm+constant", "--reps", 2)
    await merge_runner(*part, "--conditions", "N_0_0")
    told = await merge_runner(*part, "--dry-run", "--json")
    assert (told.summary["trials"], told.summary["calls"]) == (40, 0)


async def test_a_mirrored_pair_replays_to_itself_and_is_one_driver_in_tables_and_summary(
    merge_runner, tmp_path
):
    run = await merge_runner("sweep", *PAIR, "--json")
    counts = {row["level"]: row["trials"] for row in run.summary["outcomes_by_level"]}
    assert (run.code, counts["emulator+projected-order"]) == (0, 6), run.err
    assert (await merge_runner("replay", *PAIR, "--db", "again.duckdb")).code == 0
    digest = results_digest(tmp_path / "results/merge.duckdb")
    assert digest == results_digest(tmp_path / "again.duckdb")
    tables = await merge_runner("tables", "ablation-quantitative", "--format", "csv")
    assert "emulator+projected-order/baseline" in tables.out
    assert "projected-order+emulator" not in tables.out
    notes = " ".join((await merge_runner("tables", "who-first")).out.split())
    assert "emulator drove on the left in 3 trials, and on the right in 3, mirrored" in notes
