"""Bounded concurrency over any asynchronous job, and an event loop that stays awake."""

from __future__ import annotations

import asyncio
from collections import deque
from collections.abc import Awaitable, Callable, Iterable
from typing import TypeVar

ResultT = TypeVar("ResultT")
A_FEW = 16


class Gate:
    """Lets a few through in each round of the event loop, so that each round stays short.

    Thousands of calls that are all ready at once would keep the loop from everything else.
    """

    def __init__(self) -> None:
        self._free = A_FEW
        self._waiting: deque[asyncio.Future[None]] = deque()

    async def enter(self) -> None:
        """Pass, or wait for a later round; first come, first served."""
        loop = asyncio.get_running_loop()
        if self._free == A_FEW:
            loop.call_soon(self._next_round)
        if self._free and not self._waiting:
            self._free -= 1
            return
        turn = loop.create_future()
        self._waiting.append(turn)
        await turn

    def _next_round(self) -> None:
        self._free = A_FEW
        while self._waiting and self._free:
            turn = self._waiting.popleft()
            if not turn.done():
                turn.set_result(None)
                self._free -= 1
        if self._free < A_FEW:
            asyncio.get_running_loop().call_soon(self._next_round)


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
