"""Stop requests for a run, from outside of it."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager

INTERRUPTED = 130
GO_ON = "Run the same command again to go on."
Stopping = Callable[
    [Callable[[], object] | None, Callable[[], object]], AbstractContextManager[None]
]
"""A context in which a run can be stopped: the first function stops it, the second one drops the
calls that it still waits for. The first is None if nothing is left to stop."""


def on_event(event: asyncio.Event | None) -> Stopping:
    """Return the Stopping of a run that an event stops; None: nothing does."""

    @contextmanager
    def waiting(stop: Callable[[], object] | None, _: Callable[[], object]) -> Iterator[None]:
        async def call_when_set(event: asyncio.Event, stop: Callable[[], object]) -> None:
            await event.wait()
            stop()

        task = asyncio.create_task(call_when_set(event, stop)) if event and stop else None
        try:
            yield
        finally:
            if task is not None:
                task.cancel()

    return waiting


NEVER = on_event(None)
