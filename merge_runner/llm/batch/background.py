"""What goes on beside the calls: tasks whose errors reach the lines that they serve."""

from __future__ import annotations

import asyncio
from collections.abc import Coroutine, Iterable
from typing import Any

from merge_runner.llm.batch.lines import Line


class Background:
    """The tasks of a run's batches."""

    def __init__(self) -> None:
        self._tasks: set[asyncio.Task[None]] = set()
        self._resting: set[asyncio.Task[Any] | None] = set()
        self._closing = False

    def start(
        self, work: Coroutine[Any, Any, None], lines: Iterable[Line], *, reads: bool = False
    ) -> None:
        """Do something in a task of its own; what it raises is raised for these lines.

        One that only ``reads`` can be dropped at any time.
        """
        task = asyncio.create_task(work)
        self._tasks.add(task)
        if reads:
            self._resting.add(task)

        def done(task: asyncio.Task[None]) -> None:
            self._tasks.discard(task)
            self._resting.discard(task)
            error = None if task.cancelled() else task.exception()
            if error is not None:
                for line in list(lines):
                    line.fails(error)

        task.add_done_callback(done)

    async def rest(self, seconds: float) -> None:
        """Sleep, as a part of a task that can be dropped meanwhile, and from then on."""
        if self._closing:
            raise asyncio.CancelledError
        task = asyncio.current_task()
        was_resting = task in self._resting
        self._resting.add(task)
        try:
            await asyncio.sleep(seconds)
        finally:
            if not was_resting:
                self._resting.discard(task)

    async def close(self) -> None:
        """Drop what can be dropped, and wait until all else rests or has ended."""
        self._closing = True
        for task in self._tasks & self._resting:
            task.cancel()
        await asyncio.gather(*self._tasks, return_exceptions=True)
