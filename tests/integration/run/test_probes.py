"""First situations, asked without the loop: the same calls as a sweep's first decisions."""

import json
import re

from aiohttp import web

from merge_runner.records import SLOT_HEADER
from merge_runner.results.store import query, results_digest
from merge_runner.run.selection import USUAL_GRID
from merge_runner.scenarios.merge.conditions import CONDITIONS
from tests.support.crossed_study import MODEL
from tests.support.harness import FAST, RECORDING, watched

DB = "results/merge.duckdb"
DIGEST = "c25fea54ec083b0c0270edb5f331192cf023a2bfb786a8e6078f2242b7eb6bf2"
POINT = ("--conditions", "N_0_0,h2_dv-1.2")  # one of a grid
# A reply of 1000 tokens costs 1 USD at most.
FIRST = ("sweep", "baseline", "--first")
PRICED = MODEL.replace("4000", "1000").format(name="paid", price=0.0)


async def test_22_situations_are_asked_as_often_as_wanted_and_nothing_else_is(merge_runner):
    async with watched() as server:
        ask = (*FIRST, "--reps", 2, "--json")
        told = (await merge_runner(*ask, "--dry-run", **server.env)).summary
        assert (told["trials"], told["calls"], server.requests) == (22, 44, 0)
        run = await merge_runner(*ask, code=0, **server.env)
        assert run.summary["calls"] == {"live": 44, "cached": 0}
        slots = [json.loads(headers[SLOT_HEADER]) for headers in server.headers]
    assert sorted((s["decision"], s["condition"], s["side"], s["repetition"]) for s in slots) == (
        sorted((0, c, s, r) for c in CONDITIONS for s in ("left", "right") for r in (1, 2))
    )
    looks = run.summary["first_looks"]
    assert sum(look["asked"] for look in looks) == 44
    assert {look["relative_velocity_mps"] for look in looks} == {-0.8, 0.0, 0.8}
    assert "trials: 22/22 ended" in run.err


async def test_a_sweep_answers_the_situations_and_they_answer_its_first_decisions(
    merge_runner, tmp_path
):
    part = ("--reps", 1, *POINT, "--json")
    shown = ("tables", "ablation-quantitative", "attempts", "--format", "csv")
    swept = (await merge_runner("sweep", "baseline", *part)).summary
    before = (await merge_runner(*shown)).out
    asked = (await merge_runner(*FIRST, *part)).summary
    assert asked["calls"] == {"live": 0, "cached": 4}
    assert (await merge_runner(*shown)).out == before != "", "trials are shown as before"
    begun, situation = (
        query(
            tmp_path / DB,
            "select condition, side, step, time_s, position_m, velocity_mps, acceleration_mps2 "
            "from states join trials using (trial_id, spec_hash) "
            f"where step <= 5 and (source = 'first_decision') = {seat} order by all",
        )[1]
        for seat in (False, True)
    )
    assert (situation, len(situation)) == (begun, 2 * 2 * 6)
    ends = query(
        tmp_path / DB, "select max(end_time_s) from trials where source = 'first_decision'"
    )
    assert ends[1] == [(1.0,)]
    elsewhere = (*part, "--db", "other.duckdb", "--cache", "other")
    first = (await merge_runner(*FIRST, *elsewhere)).summary
    assert first["calls"] == {"live": 4, "cached": 0}
    after = (await merge_runner("sweep", "baseline", *elsewhere)).summary
    assert after["calls"] == {"live": swept["calls"]["live"] - 4, "cached": 4}
    audit = await merge_runner("audit", "--db", "other.duckdb")
    assert (audit.code, audit.out.count("all holds")) == (0, 3), audit.out


async def test_replayed_imported_and_forgotten_situations_are_the_same_without_a_call(
    merge_runner, tmp_path
):
    ask = (*FIRST, "--grid", "h=-6:6:6,dv=1.2", "--reps", 1, "--json")
    assert (await merge_runner(*ask)).summary["calls"] == {"live": 6, "cached": 0}
    assert (await merge_runner(*ask)).summary["trials"]["stored_before"] == 3
    for command in (
        ("recording", "export", "asked.parquet"),
        ("audit", "--recording", "asked.parquet"),
        ("recording", "import", "asked.parquet", "--cache", "new"),
    ):
        assert (await merge_runner(*command)).code == 0
    away = {"EMULATOR_BASE_URL": "http://127.0.0.1:9/v1"}
    for places in (
        ("--db", "file.duckdb", "--recording", "asked.parquet", "--cache", "none"),
        ("--db", "cache.duckdb", "--cache", "new"),
    ):
        run = await merge_runner(*ask, "--replay", *places, **away)
        assert (run.code, run.summary["calls"]) == (0, {"live": 0, "cached": 6}), run.err
    digests = {results_digest(tmp_path / name) for name in (DB, "file.duckdb", "cache.duckdb")}
    assert digests == {(DIGEST, 3)}, "as in databases of schema 9"
    assert (await merge_runner("forget", "*", "--yes")).code == 0
    assert results_digest(tmp_path / DB)[1] == 0
    assert (await merge_runner(*ask)).summary["calls"] == {"live": 0, "cached": 6}
    assert digests == {results_digest(tmp_path / DB)}
    recorded = ("--conditions", "N_0_0", "--recording", RECORDING, "--db", "all.duckdb", "--json")
    run = await merge_runner(*FIRST, "--replay", *recorded)
    assert run.summary["calls"] == {"live": 0, "cached": 20}, "the repetitions of a sweep"


async def test_no_more_is_spent_than_the_cap_and_more_money_goes_on(merge_runner, tmp_path):
    (tmp_path / "models.toml").write_text(PRICED.replace("output = 0.0", "output = 1000.0"))
    (tmp_path / "mine.toml").write_text(
        'repetitions = 2\nconditions = ["N_0_0"]\n[factors]\nprompt = ["baseline", "A1"]\n'
    )
    ask = ("sweep", "mine.toml", "--first", "--model", "paid", "--json", *FAST)
    async with watched() as server:
        unasked = await merge_runner(*ask, **server.env)
        assert (unasked.code, "--yes" in unasked.err) == (2, True)
        assert server.requests == 0
        cap = ("--yes", "--in-flight", 1, "--max-cost")
        capped = await merge_runner(*ask, *cap, 2.1, code=3, **server.env)
        assert 0 < capped.summary["sweep_cost_usd"] <= 2.1
        waiting = "(1 of paid/baseline, 2 of paid/A1: what has ended is not balanced)"
        assert f"3 trials wait for money {waiting}: " in capped.summary["messages"][0]
        await merge_runner(*ask, *cap, 20, code=0, **server.env)
        assert set(server.asked.values()) == {1}
        assert server.requests == 8
    assert "mine/paid/set0/first" in (await merge_runner("ledger")).out


async def test_situations_that_cannot_be_asked_are_refused_before_anything_is(
    merge_runner, tmp_path
):
    (tmp_path / "mine.toml").write_text('repetitions = 1\n[scenario]\ncontrol_start = "own_exit"\n')
    async with watched() as server:
        for asked, said in (
            ((*FIRST, "--grid", "h=60,dv=0"), "error: Condition(projected_headway_m=60.0"),
            ((*FIRST, "--grid", "usual", *POINT), "takes the place of the conditions"),
            (("sweep", "mine.toml", "--first"), 'control_start = "both_exits"'),
        ):
            run = await merge_runner(*asked, **server.env)
            assert (run.code, said in run.err) == (2, True), run.err
        assert server.requests == 0
    assert not (tmp_path / "results").exists()
    told = " ".join((await merge_runner(*FIRST, "--help")).out.split())
    assert f"`--grid usual` is {USUAL_GRID}" in told


async def wordless(request: web.Request, handler) -> web.StreamResponse:
    body = json.loads((await handler(request)).body)
    body["choices"][0]["message"]["content"] = "I would rather not say."
    return web.json_response(body)


async def test_no_question_depends_on_an_answer_and_each_driver_of_a_pair_is_summed_up_apart(
    merge_runner, tmp_path
):
    """So that a batch can carry them all."""
    (tmp_path / "mine.toml").write_text(
        'repetitions = 1\nmodels = ["emulator+constant"]\nconditions = ["N_0_0"]\n'
        '[factors]\nprompt = ["baseline", "A4"]\nprompt_rate_hz = [1.0, 0.5]\n'
    )
    ask, asked, looks = ("sweep", "mine.toml", "--first", "--mirror", "--keep-going"), [], []
    for middle, name in ((None, "usual"), (wordless, "wordless")):
        async with watched(middle) as server:
            places = ("--cache", name, "--db", f"{name}.duckdb")
            run = await merge_runner(*ask, "--json", *places, code=0, **server.env)
            asked.append(server.asked)
            looks.append(run.summary["first_looks"])
    assert asked[0] == asked[1]
    assert asked[0].total() == 2 * 4
    of_one = [look for look in looks[0] if look["variant"] == "A4"]
    assert {(look["model"], look["side"]) for look in of_one} == {
        (model, side) for model in ("constant", "emulator") for side in ("left", "right")
    }
    for usual, silent in zip(*looks, strict=True):
        plan = (silent["share_m"], silent["first_action_mps2"])
        if silent["model"] == "constant":
            assert (usual["with_a_word"], plan) == (0, (None, 0.0))
        else:
            assert usual["with_a_word"] == silent["invalid"] == silent["asked"]
            assert plan == (None, None)
    ends = query(tmp_path / "usual.duckdb", "select distinct end_time_s from trials order by all")
    assert ends[1] == [(1.0,), (2.0,)]
    told = (await merge_runner(*ask, "--db", "usual.duckdb")).out
    for model in ("constant", "emulator"):
        assert re.search(rf"\nemulator\+constant.* baseline .* {model} ", told)
    only = ("--only", "prompt=A4", "--dry-run", "--db", "part.duckdb", "--cache", "none", "--json")
    assert (await merge_runner(*ask, *only)).summary["trials"] == 4
