import asyncio

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from merge_runner.errors import BudgetExhausted
from merge_runner.llm.budget import Budget

CAP = 100
spending = st.lists(
    st.tuples(
        st.integers(0, 120),  # the worst case
        st.none() | st.integers(0, 100),  # the share of it that is spent, None if unknown
        st.integers(0, 4),  # how long it is in flight
    ),
    max_size=25,
)


@settings(deadline=None)
@given(spending)
def test_what_is_spent_and_reserved_never_exceeds_the_cap(plan):
    budget = Budget(CAP)
    committed = 0

    async def call(worst, share, turns):
        nonlocal committed
        await budget.reserve(worst)
        committed += worst
        assert committed <= CAP
        for _ in range(turns):
            await asyncio.sleep(0)
        actual = None if share is None else worst * share // 100
        committed += 0 if actual is None else actual - worst
        budget.settle(worst, actual)

    async def all_calls():
        # The limit only ends a test in which somebody waits for ever.
        async with asyncio.timeout(5):
            return await asyncio.gather(*(call(*each) for each in plan), return_exceptions=True)

    for (worst, _, _), result in zip(plan, asyncio.run(all_calls()), strict=True):
        assert result is None or isinstance(result, BudgetExhausted)
        # Who was refused would not have fitted in the end either.
        assert result is None or committed + worst > CAP


async def soon(budget, worst):
    """A reservation under way, after everybody could run."""
    task = asyncio.create_task(budget.reserve(worst))
    await asyncio.sleep(0)
    await asyncio.sleep(0)
    return task


async def test_a_reservation_waits_for_what_is_in_flight():
    budget = Budget(1.0)
    await budget.reserve(0.75)
    waiting = await soon(budget, 0.5)
    assert not waiting.done()
    budget.settle(0.75, 0.25)
    await waiting


async def test_a_reservation_is_refused_when_what_was_in_flight_has_spent_too_much():
    budget = Budget(1.0)
    await budget.reserve(0.75)
    waiting = await soon(budget, 0.5)
    budget.settle(0.75, 0.75)
    with pytest.raises(BudgetExhausted, match="--max-cost"):
        await waiting


async def test_with_nothing_in_flight_the_next_call_is_refused_at_once():
    budget = Budget(1.0)
    await budget.reserve(1.0)
    budget.settle(1.0, 1.0)
    with pytest.raises(BudgetExhausted):
        await budget.reserve(0.01)


async def test_the_cap_itself_can_be_spent():
    budget = Budget(1.0)
    await budget.reserve(0.5)
    await budget.reserve(0.5)


async def test_an_unknown_cost_keeps_the_whole_reservation():
    budget = Budget(1.0)
    await budget.reserve(0.75)
    budget.settle(0.75, None)
    with pytest.raises(BudgetExhausted):
        await budget.reserve(0.5)
    await budget.reserve(0.25)


async def test_all_who_wait_are_looked_at_after_each_settlement():
    budget = Budget(1.0)
    await budget.reserve(1.0)
    large, small, smaller = [await soon(budget, worst) for worst in (0.75, 0.25, 0.125)]
    budget.settle(1.0, 0.5)
    await asyncio.gather(small, smaller)
    with pytest.raises(BudgetExhausted):
        await large


async def test_without_a_cap_everything_passes():
    budget = Budget()
    for _ in range(3):
        await budget.reserve(10.0**9)
    budget.settle(10.0**9, 10.0**9)
    await budget.reserve(10.0**9)
