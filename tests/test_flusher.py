"""Room for trials that are not stored yet."""

from __future__ import annotations

import asyncio

import pytest

from merge_runner.errors import StoreLocked
from merge_runner.flusher import MOST_PENDING, Flusher


class Refusing:
    """A store that raises what it is told to."""

    def __init__(self, error):
        self.error = error

    def write(self, sweep_id, batch, *, patience_s):
        raise self.error


@pytest.mark.parametrize("error", [StoreLocked("somebody reads"), KeyError("a fault of ours")])
async def test_trials_wait_for_no_reader_and_no_flusher_that_is_gone(error):
    flusher = Flusher(Refusing(error), "sweep", lambda line: None)
    for number in range(2 * MOST_PENDING):
        flusher.add(number)
    async with asyncio.timeout(10):
        await flusher.room()
    flusher._task.cancel()
    await asyncio.gather(flusher._task, return_exceptions=True)
