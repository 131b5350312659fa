"""First situations, asked without the loop: the same calls as a sweep's first decisions."""

from __future__ import annotations

import json
import re

import pytest
from aiohttp import web

from merge_runner.records import SLOT_HEADER
from merge_runner.results.store import query, results_digest
from merge_runner.run.plan import USUAL_GRID
from merge_runner.scenarios.merge.conditions import CONDITIONS
from tests.support.harness import FAST, RECORDING, watched

DB = "results/merge.duckdb"
TWO = ("--conditions", "N_0_0,L_4_8")
POINT = ("--conditions", "N_0_0,h2_dv-1.2")  # one of a grid
# A reply of 1000 tokens costs 1 USD at most.
FIRST = ("sweep", "baseline", "--first")
PRICED = """
[paid]
provider = "emulator"
format = "openai-chat"
id = "scripted-driver"
max_output_tokens = 1000
price = { input = 0.0, output = 1000.0, source = "test" }
"""


async def test_22_situations_are_asked_as_often_as_wanted_and_nothing_else_is(merge_runner):
    async with watched() as server:
        env = {"EMULATOR_BASE_URL": f"{server.url}/v1"}
        run = await merge_runner(*FIRST, "--reps", 2, "--json", **env)
        assert run.code == 0, run.err
        assert run.summary["calls"] == {"live": 44, "cached": 0}
        slots = [json.loads(headers[SLOT_HEADER]) for headers in server.headers]
    assert sorted((s["decision"], s["condition"], s["side"], s["repetition"]) for s in slots) == (
        sorted((0, c, s, r) for c in CONDITIONS for s in ("left", "right") for r in (1, 2))
    )
    looks = run.summary["first_looks"]
    assert sum(look["asked"] for look in looks) == 44
    assert {look["relative_velocity_mps"] for look in looks} == {-0.8, 0.0, 0.8}
    assert "44 live" in run.err


@pytest.fixture(scope="module")
def both(prepare, tmp_path_factory):
    """A folder with a sweep and its situations, its tables before and after, and what was asked."""
    folder = tmp_path_factory.mktemp("both")
    part = ("--reps", 1, *POINT, "--json")
    shown = ("tables", "ablation-quantitative", "attempts", "--format", "csv")
    swept = prepare(folder, "sweep", "baseline", *part).summary
    before = prepare(folder, *shown).out
    asked = prepare(folder, *FIRST, *part).summary
    return folder, swept, asked, (before, prepare(folder, *shown).out)


def test_a_sweep_answers_the_situations_and_they_answer_its_first_decisions(prepare, both):
    folder, swept, asked, _ = both
    assert asked["calls"] == {"live": 0, "cached": 4}
    elsewhere = ("--reps", 1, *POINT, "--json", "--db", "other.duckdb", "--cache", "other")
    before = prepare(folder, *FIRST, *elsewhere).summary
    assert before["calls"] == {"live": 4, "cached": 0}
    after = prepare(folder, "sweep", "baseline", *elsewhere).summary
    assert after["calls"] == {"live": swept["calls"]["live"] - 4, "cached": 4}
    audit = prepare(folder, "audit", "--db", "other.duckdb")
    assert (audit.code, audit.out.count("all holds")) == (0, 3), audit.out


def test_a_situation_is_driven_for_a_second_as_its_trial_begins(both):
    sql = (
        "select condition, side, step, time_s, position_m, velocity_mps, acceleration_mps2 "
        "from states join trials using (trial_id, spec_hash) where step <= 5 and source {} 'seat' "
        "order by all"
    )
    db = both[0] / DB
    trial, asked = (query(db, sql.format(which))[1] for which in ("<>", "="))
    assert asked == trial
    assert len(asked) == 2 * 2 * 6
    assert query(db, "select max(end_time_s) from trials where source = 'seat'")[1] == [(1.0,)]


def test_the_trials_that_were_driven_are_shown_as_before(both):
    before, after = both[3]
    assert before == after != ""


async def test_replayed_imported_and_forgotten_situations_are_the_same_without_a_call(
    merge_runner, tmp_path
):
    ask = (*FIRST, "--grid", "h=-6:6:6,dv=1.2", "--reps", 1, "--json")
    assert (await merge_runner(*ask)).summary["calls"] == {"live": 6, "cached": 0}
    assert (await merge_runner(*ask)).summary["trials"]["stored_before"] == 3
    assert (await merge_runner("recording", "export", "asked.parquet")).code == 0
    assert (await merge_runner("audit", "--recording", "asked.parquet")).code == 0
    assert (await merge_runner("recording", "import", "asked.parquet", "--cache", "new")).code == 0
    away = {"EMULATOR_BASE_URL": "http://127.0.0.1:9/v1"}
    for places in (
        ("--db", "file.duckdb", "--recording", "asked.parquet", "--cache", "none"),
        ("--db", "cache.duckdb", "--cache", "new"),
    ):
        run = await merge_runner(*ask, "--replay", *places, **away)
        assert (run.code, run.summary["calls"]) == (0, {"live": 0, "cached": 6}), run.err
    digests = {results_digest(tmp_path / name) for name in (DB, "file.duckdb", "cache.duckdb")}
    assert (await merge_runner("forget", "*", "--yes")).code == 0
    assert results_digest(tmp_path / DB)[1] == 0
    assert (await merge_runner(*ask)).summary["calls"] == {"live": 0, "cached": 6}
    assert digests == {results_digest(tmp_path / DB)}
    replay = ("replay", "baseline", "--reps", 1, "--conditions", "N_0_0", "--cache", "none")
    sweep = await merge_runner(*replay, "--recording", "asked.parquet", "--db", "sweep.duckdb")
    said = "asked.parquet holds 6 calls of scripted-driver"
    assert (sweep.code, said in sweep.err) == (4, True), sweep.err


async def test_a_replay_without_a_number_plays_the_repetitions_that_a_sweep_recorded(merge_runner):
    part = ("--conditions", "N_0_0", "--recording", RECORDING, "--json")
    run = await merge_runner(*FIRST, "--replay", *part)
    assert run.code == 0, run.err
    assert run.summary["calls"] == {"live": 0, "cached": 20}


async def test_no_more_is_spent_than_the_cap_and_more_money_goes_on(merge_runner, tmp_path):
    (tmp_path / "models.toml").write_text(PRICED)
    (tmp_path / "mine.toml").write_text(
        'repetitions = 2\nconditions = ["N_0_0"]\n[factors]\nprompt = ["baseline", "A1"]\n'
    )
    ask = ("sweep", "mine.toml", "--first", "--model", "paid", "--json", *FAST)
    async with watched() as server:
        env = {"EMULATOR_BASE_URL": f"{server.url}/v1"}
        unasked = await merge_runner(*ask, **env)
        assert (unasked.code, "--yes" in unasked.err) == (2, True)
        assert server.requests == 0
        cap = ("--yes", "--in-flight", 1, "--max-cost")
        capped = await merge_runner(*ask, *cap, 2.1, **env)
        assert capped.code == 3, capped.err
        assert 0 < capped.summary["sweep_cost_usd"] <= 2.1
        waiting = "(1 of paid/baseline, 2 of paid/A1: what has ended is not balanced)"
        assert f"3 trials wait for money {waiting}: " in capped.summary["messages"][0]
        run = await merge_runner(*ask, *cap, 20, **env)
        assert run.code == 0, run.err
        assert set(server.asked.values()) == {1}
        assert server.requests == 8
    assert "mine/paid/set0/first" in (await merge_runner("ledger")).out


async def test_an_estimate_counts_one_call_a_situation(merge_runner):
    run = await merge_runner(*FIRST, "--reps", 2, "--dry-run", "--json")
    assert (run.summary["trials"], run.summary["calls"]) == (22, 44)


async def test_the_two_drivers_of_a_pair_are_summed_up_apart(merge_runner):
    pair = ("--model", "emulator+constant", "--mirror", "--reps", 1, "--conditions", "N_0_0")
    run = await merge_runner(*FIRST, *pair, "--json")
    assert run.code == 0, run.err
    looks = run.summary["first_looks"]
    assert [(look["model"], look["side"], look["asked"]) for look in looks] == [
        ("constant", "left", 1),
        ("constant", "right", 1),
        ("emulator", "left", 1),
        ("emulator", "right", 1),
    ]
    assert [look["with_a_word"] for look in looks] == [0, 0, 1, 1]
    of_a_program = [(look["share_m"], look["first_action_mps2"]) for look in looks[:2]]
    assert of_a_program == [(None, 0.0)] * 2
    again = await merge_runner(*FIRST, *pair)
    for model in ("constant", "emulator"):
        assert f"\nemulator+constant  baseline  {model} " in again.out


async def test_factors_and_prompts_of_a_study_are_asked(merge_runner, tmp_path):
    (tmp_path / "mine.toml").write_text(
        'repetitions = 1\nmodels = ["emulator"]\nconditions = ["N_0_0"]\n'
        '[factors]\nprompt = ["baseline", "A4"]\nprompt_rate_hz = [1.0, 0.5]\n'
    )
    run = await merge_runner("sweep", "mine.toml", "--first", "--json")
    assert run.code == 0, run.err
    assert run.summary["calls"]["live"] == 2 * 4
    query = "select distinct end_time_s from trials order by all"
    assert (await merge_runner("sql", query, "--format", "csv")).out.split()[1:] == ["1.0", "2.0"]
    only = ("--only", "prompt=A4", "--dry-run", "--db", "part.duckdb", "--cache", "none")
    part = await merge_runner("sweep", "mine.toml", "--first", "--json", *only)
    assert part.summary["trials"] == 2


async def test_the_usual_grid_is_the_one_that_help_tells(merge_runner):
    told = " ".join((await merge_runner(*FIRST, "--help")).out.split())
    assert "usual: {} and {}".format(*re.findall(r"=([^,]+)", USUAL_GRID)) in told


async def test_situations_that_cannot_be_asked_are_refused_before_anything_is(
    merge_runner, tmp_path
):
    async with watched() as server:
        env = {"EMULATOR_BASE_URL": f"{server.url}/v1"}
        near = await merge_runner(*FIRST, "--grid", "h=60,dv=0", **env)
        both = await merge_runner(*FIRST, "--grid", "usual", *TWO, **env)
        (tmp_path / "mine.toml").write_text(
            'repetitions = 1\n[scenario]\ncontrol_start = "own_exit"\n'
        )
        tunnel = await merge_runner("sweep", "mine.toml", "--first", **env)
        assert server.requests == 0
    assert "error: Condition(projected_headway_m=60.0, relative_velocity_mps=0.0" in near.err
    assert (near.code, "at the merge point before both are driven" in near.err) == (2, True)
    assert (both.code, "takes the place of the conditions" in both.err) == (2, True)
    assert (tunnel.code, 'control_start = "both_exits"' in tunnel.err) == (2, True)
    assert not (tmp_path / "results").exists()


async def wordless(request: web.Request, handler) -> web.StreamResponse:
    body = json.loads((await handler(request)).body)
    body["choices"][0]["message"]["content"] = "I would rather not say."
    return web.json_response(body)


async def test_no_question_depends_on_an_answer_and_replies_without_a_plan_are_counted(
    merge_runner,
):
    """So that a batch can carry them all."""
    asked = []
    for middle, name in ((None, "usual"), (wordless, "wordless")):
        async with watched(middle) as server:
            places = ("--cache", name, "--db", f"{name}.duckdb")
            ask = (*FIRST, "--reps", 1, "--keep-going", "--conditions", "N_0_0", "--json", *places)
            run = await merge_runner(*ask, EMULATOR_BASE_URL=f"{server.url}/v1")
            assert run.code == 0, run.err
            asked.append(server.asked)
    assert asked[0] == asked[1]
    for look in run.summary["first_looks"]:
        assert look["invalid"] == look["asked"]
        assert (look["share_m"], look["first_action_mps2"]) == (None, None)
