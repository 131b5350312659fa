"""Who is stopped for want of a valid decision, and who waits for the first one."""

import asyncio

import pytest

from merge_runner.errors import NoValidDecision
from merge_runner.records import Decision
from merge_runner.run.local_runner import MOST_INVALID, FirstDecisions

VALID, INVALID = Decision((0.0,), (0.0,)), Decision(None, (0.0,), failure="no_array", fallback=True)


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
