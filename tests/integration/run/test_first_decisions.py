"""A model that gives no valid decision, live, in batches and from recordings."""

import asyncio

import pytest

from merge_runner.errors import NoValidDecision
from merge_runner.records import Decision
from merge_runner.run.local_runner import MOST_INVALID, FirstDecisions
from tests.support.harness import watched
from tests.support.mock_server import FaultPlan

SWEEP = ("sweep", "baseline", "--json")
PROSE = FaultPlan(rates={"malformed": 1.0})
VALID, INVALID = Decision((0.0,), (0.0,)), Decision(None, (0.0,), failure="no_array", fallback=True)


async def test_a_live_run_stops_after_20_invalid_decisions_and_keeps_what_was_answered(
    merge_runner,
):
    async with watched(faults=PROSE) as server:
        env = {"EMULATOR_BASE_URL": f"{server.url}/v1"}
        stopped = await merge_runner(*SWEEP, **env)
        assert (stopped.code, server.requests) == (1, MOST_INVALID)
        (message,) = stopped.summary["messages"]
        assert message.startswith("none of the first 20 decisions of emulator is valid")
        assert 'The first reply is "M I would rather describe my plan in words than' in message
        assert "(no array). To mend that look at what" in message
        again = await merge_runner(*SWEEP, **env)
        assert (again.code, server.requests) == (1, MOST_INVALID), "it asked on"
        whole = await merge_runner(*SWEEP, "--reps", 1, "--keep-going", **env)
        assert whole.code == 0, whole.err
        assert whole.summary["invalid_decisions"] == whole.summary["decisions"] > MOST_INVALID
        assert set(server.asked.values()) == {1}, "an answered call was asked again"
    replay = await merge_runner("replay", "baseline", "--reps", 1, "--db", "replayed", "--json")
    assert replay.code == 0, "a replay plays what is recorded"


@pytest.mark.slow
@pytest.mark.parametrize(
    "command",
    [("sweep", "baseline", "--reps", 1), ("sweep", "baseline", "--first", "--reps", 1)],
    ids=["sweep", "first"],
)
async def test_a_run_of_fewer_decisions_says_at_its_end_that_none_is_valid(merge_runner, command):
    part = (*command, "--conditions", "N_0_0", "--json")
    async with watched(faults=PROSE) as server:
        env = {"EMULATOR_BASE_URL": f"{server.url}/v1"}
        for _ in range(2):  # the second asks nothing
            run = await merge_runner(*part, **env)
            assert run.code == run.summary["exit_code"] == 1
            decisions = run.summary["decisions"]
            assert run.summary["invalid_decisions"] == decisions < MOST_INVALID
            (message,) = run.summary["messages"]
            assert message.startswith(
                f"none of the first {decisions} decisions of emulator is valid. "
            )
            assert "(no array). To mend that look at what" in message
        assert (await merge_runner(*part, "--keep-going", **env)).code == 0


async def test_a_run_in_batches_stops_after_the_first_round_and_pays_it_once(merge_runner):
    sweep = (*SWEEP, "--reps", 2, "--batch")
    async with watched(faults=PROSE) as server:
        env = {"EMULATOR_BASE_URL": f"{server.url}/v1"}
        for _ in range(2):
            stopped = await merge_runner(*sweep, **env)
            assert stopped.code == 1
            assert "none of the first 20 decisions of emulator" in stopped.summary["messages"][0]
        assert server.paths.count("/v1/batches") == 1, "it began another round"
        assert "/v1/chat/completions" not in server.paths


@pytest.mark.long
async def test_so_does_one_on_a_cluster(merge_runner):
    async with watched(faults=PROSE) as server:
        env = {"EMULATOR_BASE_URL": f"{server.url}/v1"}
        sweep = (*SWEEP, "--reps", 4, "--in-flight", 2, "--dask", "local:1")
        stopped = await merge_runner(*sweep, **env)
    assert stopped.code == 1, stopped.err
    assert "decisions of emulator is valid" in stopped.summary["messages"][0]
    assert server.requests < 100, "it asked all"


async def test_what_the_emulator_cannot_read_is_told_and_the_model_random_rehearses_it(
    merge_runner, tmp_path
):
    (tmp_path / "mine.toml").write_text(
        'repetitions = 2\nconditions = ["N_0_0", "L_4_0"]\n[factors]\nprompt = ["german"]\n'
        '[prompts.german]\nremove = ["C1", "C2", "C3.safety", "C3.human", "C4", "C5"]\n'
        'replace = { C0 = "Sie fahren {own_speed} m/s. Nennen Sie {plan_actions} Zahlen." }\n'
    )
    unread = await merge_runner("sweep", "mine.toml", "--json")
    assert unread.code == 1
    assert "cannot read this prompt: it does not say `Your speed: N m/s`, `Speed" in unread.err
    assert "The model `random` answers any prompt" in unread.err
    run = await merge_runner("sweep", "mine.toml", "--model", "random", "--json")
    assert run.code == 0, run.err
    assert run.summary["trials"]["failed"] == run.summary["invalid_decisions"] == 0
    assert run.summary["decisions"] > 10


def test_one_valid_decision_is_enough_and_each_model_is_counted_by_itself():
    first = FirstDecisions(MOST_INVALID)
    for _ in range(MOST_INVALID - 1):
        first.count("a", INVALID)
        first.count("b", INVALID)
    first.count("a", VALID)
    for _ in range(MOST_INVALID):
        first.count("a", INVALID)
    with pytest.raises(NoValidDecision, match=r"of b is valid.*is \"\" .no array"):
        first.count("b", INVALID)


async def test_trials_wait_for_the_first_valid_decision_of_each_of_their_models():
    first, begun = FirstDecisions(MOST_INVALID, one_by_one=True), []

    async def trial(number, models, end):
        async with first.turn(models):
            begun.append(number)
            await end.wait()

    async def settled():
        for _ in range(10):
            await asyncio.sleep(0)
        return sorted(begun)

    never, soon = asyncio.Event(), asyncio.Event()
    async with asyncio.TaskGroup() as group:
        group.create_task(trial(1, ["a"], never))
        group.create_task(trial(2, ["b", "a"], never))
        group.create_task(trial(3, ["a", "b"], soon))
        group.create_task(trial(4, ["c"], never))
        group.create_task(trial(5, ["a"], never))
        assert await settled() == [1, 4]
        first.count("a", VALID)
        assert await settled() == [1, 2, 4, 5]  # b has decided nothing yet
        first.count("b", INVALID)
        assert await settled() == [1, 2, 4, 5]
        first.count("b", VALID)
        assert await settled() == [1, 2, 3, 4, 5]
        never.set()
        soon.set()
