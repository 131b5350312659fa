"""Batches of small durable writes: one transaction for all that gathers during the last one.

A durable write waits some milliseconds for the disk however little it writes, so that one for each
reply would bound a sweep to a few hundred calls a second.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from typing import Any, TypeVar

ResultT = TypeVar("ResultT")
Operation = Callable[[], Any]


class BatchWriter:
    """Hands operations to ``run`` in batches, in a thread, one batch at a time."""

    def __init__(self, run: Callable[[list[Operation]], list[Any]]) -> None:
        self._run = run
        self._pending: list[Operation] = []
        self._next_batch: asyncio.Task[list[Any]] | None = None
        self._one_batch_at_a_time = asyncio.Lock()

    async def write(self, operation: Callable[[], ResultT]) -> ResultT:
        """Run an operation in the next batch; returns its result once the batch is durable."""
        # Whoever comes first begins a batch; all who come until its writing begins join it.
        if self._next_batch is None:
            self._next_batch = asyncio.create_task(self._write_batch())
        batch, place = self._next_batch, len(self._pending)
        self._pending.append(operation)
        # Shielded: if one gives up waiting, the writes of the others go on.
        result: ResultT = (await asyncio.shield(batch))[place]
        return result

    async def _write_batch(self) -> list[Any]:
        """Write all that has gathered while the previous batch was written."""
        async with self._one_batch_at_a_time:
            operations, self._pending, self._next_batch = self._pending, [], None
            # In a thread, since the event loop must not wait for a disk.
            return await asyncio.to_thread(self._run, operations)
