"""What a worker holds of the coordinator's, over a real connection, however it ends."""

from __future__ import annotations

import asyncio
from collections import Counter
from types import SimpleNamespace

import pytest
from distributed.comm import connect, listen

from merge_runner.llm.budget import Budget
from merge_runner.llm.cache import CachedCall, KnownCall, ResponseCache
from merge_runner.llm.content_hashes import make_request
from merge_runner.llm.ledger import Asked, Ledger
from merge_runner.records import Attempt, Slot
from merge_runner.run.clients import LocalServices
from merge_runner.run.cluster.link import Link, LinkLost
from merge_runner.run.cluster.remote import RemoteBudget, RemoteCache
from merge_runner.run.cluster.session import Session
from tests.harness import each

WORST = Asked("o3", "L_4_0 rep 1 left, decision 3", 0.5, "o3")
TRIAL = 1


@pytest.fixture
def cache(tmp_path):
    opened = ResponseCache(tmp_path / "main")
    yield opened
    opened.close()


@pytest.fixture
def budget(cache):
    return Budget(Ledger(cache, "sweep"), 1.0, each(1.0, "o3"))


@pytest.fixture
async def worker(cache, budget):
    """The worker's end: its link, and the budget and the cache that it asks over it."""
    services = LocalServices({}, budget)
    run = SimpleNamespace(services=services, cache=cache, meters={}, answered=Counter())
    sessions = []

    async def serve(comm):
        session = Session(run, comm)
        session.trials = {TRIAL: None}
        sessions.append(asyncio.current_task())
        await session.serve()

    listener = listen("tcp://127.0.0.1:0", serve)
    await listener.start()
    link = Link(await connect(listener.contact_address), {})
    serving = asyncio.create_task(link.serve())

    async def dies():
        link.abort()
        await asyncio.gather(serving, *sessions)

    yield SimpleNamespace(link=link, budget=RemoteBudget(link), cache=RemoteCache(link), dies=dies)
    await dies()
    listener.stop()


def money(budget):
    """What is held in memory, set aside in the ledger, and spent."""
    spending = budget.ledger.read()
    return budget.queued_usd, spending.reserved_usd, spending.spent_usd


async def test_a_worker_that_dies_before_it_sends_gives_its_money_back(worker, budget):
    async with worker.budget.attempt(TRIAL, "key", WORST) as paid:
        assert (paid.aside_usd, money(budget)) == (0.5, (0.5, 0, 0))
        await worker.dies()
        with pytest.raises(LinkLost):
            await paid.begin([])
    assert (budget.in_flight, money(budget)) == (0, (0, 0, 0))


async def test_what_a_dead_worker_had_in_flight_stays_set_aside(worker, budget):
    async with worker.budget.attempt(TRIAL, "key", WORST) as paid:
        await paid.begin([])
        assert money(budget) == (0, 0.5, 0)
        await worker.dies()
        with pytest.raises(LinkLost):
            await paid.settle([Attempt(1, "timeout")])
    assert (budget.in_flight, money(budget)) == (0, (0, 0.5, 0))


async def test_who_gives_up_waiting_for_money_holds_none(worker, budget):
    async with worker.budget.attempt(TRIAL, "key", WORST):

        async def second():
            async with worker.budget.attempt(TRIAL + 1, "other", WORST):
                raise AssertionError("one is in flight, and two more do not fit")

        waiting = asyncio.create_task(second())
        await asyncio.sleep(0.1)
        waiting.cancel()
        await asyncio.gather(waiting, return_exceptions=True)
        assert waiting.cancelled()
    await worker.link.ask("leave", TRIAL)  # all that was told before it has been heard
    assert (budget.in_flight, money(budget)) == (0, (0, 0, 0))


async def test_who_gives_up_when_the_answer_is_under_way_holds_no_money(worker, budget):
    async def attempt():
        async with worker.budget.attempt(TRIAL, "key", WORST):
            await asyncio.Event().wait()

    # At every stage of the question and its answer, which travel for a few milliseconds.
    for milliseconds in range(12):
        asking = asyncio.create_task(attempt())
        await asyncio.sleep(milliseconds / 1000)
        asking.cancel()
        await asyncio.gather(asking, return_exceptions=True)
    await worker.link.ask("leave", TRIAL)  # all that was told before it has been heard
    assert (budget.in_flight, money(budget)) == (0, (0, 0, 0))


def answered(reply):
    request = make_request(
        provider="openai",
        endpoint="openai",
        model="m",
        path="/p",
        headers={},
        body={"prompt": "p"},
        slot=Slot("A1", 1, "left", 0, 0),
    )
    return CachedCall(request, (Attempt(1, "ok", 200, reply=reply, cost_usd=0.25),))


CALL = answered('{"text": "M"}')
KEY = CALL.request.key


async def test_a_reply_is_in_the_main_cache_before_its_worker_sees_it(worker, cache):
    assert await worker.cache.claim(KEY) == KnownCall(None, ())
    assert await worker.cache.put(CALL) == CALL
    assert cache.get(KEY) == CALL


async def test_a_paid_reply_is_kept_and_booked_at_once(worker, cache, budget):
    async with worker.budget.attempt(TRIAL, KEY, WORST) as paid:
        await paid.begin([])
        assert await paid.keep(CALL) == CALL
        assert (cache.get(KEY), money(budget)) == (CALL, (0, 0, 0.25))


async def test_a_reply_that_was_there_before_is_the_one_that_is_used(worker, cache):
    cache.put_now([CALL])
    assert await worker.cache.put(answered('{"text": "Y"}')) == CALL


async def test_what_a_lost_worker_had_claimed_can_be_claimed_by_others(worker, cache):
    await worker.cache.put_unanswered(KEY, (Attempt(1, "timeout"),))
    assert await worker.cache.claim(KEY)
    assert await cache.claim(KEY) is None
    await worker.dies()
    assert await cache.claim(KEY) == KnownCall(None, (Attempt(1, "timeout"),))
