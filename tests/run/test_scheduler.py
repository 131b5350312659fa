"""Bounded concurrency over any job."""

from __future__ import annotations

import asyncio
from functools import partial

import pytest

from merge_runner.run.local_runner import run_bounded


@pytest.mark.parametrize(("jobs", "in_flight"), [(50, 7), (3, 10), (20, 1), (0, 5)])
async def test_all_jobs_run_in_order_and_never_more_than_allowed_at_once(jobs, in_flight):
    running = most = 0
    started, done = [], []

    async def job(number):
        nonlocal running, most
        started.append(number)
        running += 1
        most = max(most, running)
        await asyncio.sleep(0)
        running -= 1
        return number

    await run_bounded(
        (partial(job, n) for n in range(jobs)), in_flight=in_flight, on_done=done.append
    )
    assert started == list(range(jobs))
    assert sorted(done) == list(range(jobs))
    assert most == min(jobs, in_flight)


async def test_the_first_exception_cancels_the_others_and_is_raised_itself():
    cancelled = []

    async def hang():
        try:
            await asyncio.Event().wait()
        finally:
            cancelled.append(True)

    async def fail():
        await asyncio.sleep(0)
        raise KeyError("mine")

    with pytest.raises(KeyError, match="mine"):
        await run_bounded([hang, hang, fail], in_flight=3, on_done=print)
    assert cancelled == [True, True]


async def test_jobs_are_taken_one_by_one_so_that_a_long_list_costs_no_memory():
    taken = 0

    def jobs():
        nonlocal taken
        for _ in range(1000):
            taken += 1
            yield partial(asyncio.sleep, 0)

    most_ahead = 0
    ended = 0

    def count(_):
        nonlocal ended, most_ahead
        ended += 1
        most_ahead = max(most_ahead, taken - ended)

    await run_bounded(jobs(), in_flight=5, on_done=count)
    assert ended == 1000
    assert most_ahead <= 5
