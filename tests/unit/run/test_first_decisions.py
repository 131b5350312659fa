"""Who is stopped for want of a valid decision, and who waits for the first one."""

import asyncio

import pytest

from merge_runner.errors import NoValidDecision
from merge_runner.records import Decision
from merge_runner.run.guard import MOST_INVALID, FirstDecisions

VALID, INVALID = Decision((0.0,), (0.0,)), Decision(None, (0.0,), failure="no_array", fallback=True)


def test_one_valid_decision_is_enough_and_each_model_is_counted_by_itself():
    first = FirstDecisions(MOST_INVALID)
    for _ in range(MOST_INVALID - 1):
        first.count_decision("a", INVALID)
        first.count_decision("b", INVALID)
    first.count_decision("a", VALID)
    for _ in range(MOST_INVALID):
        first.count_decision("a", INVALID)
    with pytest.raises(NoValidDecision, match=r"of b is valid.*is \"\" .no array"):
        first.count_decision("b", INVALID)


async def test_trials_wait_for_the_first_valid_decision_of_each_of_their_models():
    first, begun = FirstDecisions(MOST_INVALID, one_by_one=True), []
    end = asyncio.Event()

    async def trial(number, *models):
        async with first.turn(models):
            begun.append(number)
            await end.wait()

    async with asyncio.TaskGroup() as group:
        for number, models in enumerate(("a", "ba", "ab", "c", "a")):
            group.create_task(trial(number, *models))
        for model, decision, expected in (
            ("", None, [0, 3]),
            ("a", VALID, [0, 1, 3, 4]),  # b has decided nothing yet
            ("b", INVALID, [0, 1, 3, 4]),
            ("b", VALID, [0, 1, 2, 3, 4]),
        ):
            if decision:
                first.count_decision(model, decision)
            for _ in range(10):
                await asyncio.sleep(0)
            assert sorted(begun) == expected
        end.set()
