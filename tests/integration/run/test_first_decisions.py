"""A model that gives no valid decision, live, in batches and from recordings."""

import pytest

from merge_runner.run.guard import MOST_INVALID
from tests.support.harness import watched
from tests.support.mock_server import FaultPlan

SWEEP = ("sweep", "baseline", "--json")
PROSE = FaultPlan(rates={"malformed": 1.0})


async def test_a_live_run_stops_after_20_invalid_decisions_and_keeps_what_was_answered(
    merge_runner,
):
    async with watched(faults=PROSE) as server:
        stopped = await merge_runner(*SWEEP, **server.env)
        assert (stopped.code, server.requests) == (1, MOST_INVALID)
        (message,) = stopped.summary["messages"]
        assert message.startswith("none of the first 20 decisions of emulator is valid")
        assert 'The first reply is "M I would rather describe my plan in words than' in message
        assert "(no array). To mend that look at what" in message
        again = await merge_runner(*SWEEP, **server.env)
        assert (again.code, server.requests) == (1, MOST_INVALID), "it asked on"
        whole = await merge_runner(*SWEEP, "--reps", 1, "--keep-going", code=0, **server.env)
        assert whole.summary["invalid_decisions"] == whole.summary["decisions"] > MOST_INVALID
        assert whole.summary["fallbacks"] == whole.summary["invalid_decisions"]
        assert set(server.asked.values()) == {1}, "an answered call was asked again"
    replay = await merge_runner("replay", "baseline", "--reps", 1, "--db", "replayed", "--json")
    assert replay.code == 0, "a replay plays what is recorded"


@pytest.mark.parametrize("first", [(), ("--first",)])
async def test_a_run_of_fewer_decisions_says_at_its_end_that_none_is_valid(merge_runner, first):
    part = ("sweep", "baseline", *first, "--reps", 1, "--conditions", "N_0_0")
    async with watched(faults=PROSE) as server:
        for _ in range(2):  # the second asks nothing
            run = await merge_runner(*part, "--json", **server.env)
            assert run.code == run.summary["exit_code"] == 1
            decisions = run.summary["decisions"]
            assert run.summary["invalid_decisions"] == decisions < MOST_INVALID
            (message,) = run.summary["messages"]
            told = f"none of the first {decisions} decisions of emulator is valid. "
            assert message.startswith(told)
            assert "(no array). To mend that look at what" in message
        whole = await merge_runner(*part, "--keep-going", **server.env)
    assert whole.code == 0, whole.err
    told = f"decisions: {decisions}, {decisions} invalid (100.0%), {decisions} fallbacks"
    # Of no fallback was an earlier plan there.
    assert first or told in whole.out.splitlines()


async def test_a_run_in_batches_stops_after_the_first_round_and_pays_it_once(merge_runner):
    sweep = (*SWEEP, "--reps", 2, "--batch")
    async with watched(faults=PROSE) as server:
        for _ in range(2):
            stopped = await merge_runner(*sweep, code=1, **server.env)
            assert "none of the first 20 decisions of emulator" in stopped.summary["messages"][0]
        assert server.paths.count("/v1/batches") == 1, "it began another round"
        assert "/v1/chat/completions" not in server.paths


async def test_what_the_emulator_cannot_read_is_told_and_the_model_random_rehearses_it(
    merge_runner, tmp_path
):
    (tmp_path / "mine.toml").write_text(
        'repetitions = 2\nconditions = ["N_0_0", "L_4_0"]\n[factors]\nprompt = ["german"]\n'
        '[prompts.german]\nremove = ["C1", "C2", "C3.safety", "C3.human", "C4", "C5"]\n'
        'replace = { C0 = "Sie fahren {own_speed} m/s. Nennen Sie {plan_actions} Zahlen." }\n'
    )
    unread = await merge_runner("sweep", "mine.toml", "--json", code=1)
    assert "cannot read this prompt: it does not say `Your speed: N m/s`, `Speed" in unread.err
    assert "The model `random` answers any prompt" in unread.err
    run = await merge_runner("sweep", "mine.toml", "--model", "random", "--json", code=0)
    assert run.summary["trials"]["failed"] == run.summary["invalid_decisions"] == 0
    assert run.summary["decisions"] > 10
