"""Bounded concurrency over any asynchronous job."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable, Iterable
from typing import TypeVar

ResultT = TypeVar("ResultT")


async def run_bounded(
    jobs: Iterable[Callable[[], Awaitable[ResultT]]],
    *,
    in_flight: int,
    on_done: Callable[[ResultT], None],
) -> None:
    """Run jobs in order, at most ``in_flight`` at once; each result goes to ``on_done``.

    The first exception of a job cancels all others and is raised.
    """
    waiting = iter(jobs)

    async def work() -> None:
        for job in waiting:
            on_done(await job())

    try:
        async with asyncio.TaskGroup() as group:
            for _ in range(in_flight):
                group.create_task(work())
    except BaseExceptionGroup as errors:
        raise errors.exceptions[0] from None
