"""Room for trials that are not stored yet."""

from __future__ import annotations

import asyncio
import threading

import pytest

from merge_runner.errors import StoreLocked
from merge_runner.records import (
    Attempt,
    ChatReply,
    Decision,
    DecisionRow,
    TrialRecord,
    TrialSpec,
)
from merge_runner.run.flusher import MOST_PENDING, MOST_PENDING_BYTES, MOST_STUCK_BYTES, Flusher

SPEC = TrialSpec("t", "h", "llm", "m", "m", "baseline", "L_4_0", 1, 0, 0)
MB = 2**20


def trial(size):
    """A trial whose only reply has so many bytes."""
    reply = ChatReply("", "ok", None, (Attempt(1, "ok", reply="x" * size),), 0)
    decision = DecisionRow(0, 0.0, "left", Decision((), (), reply=reply))
    return TrialRecord(SPEC, "finished", None, 1.0, None, (), (decision,))


class Refusing:
    """A store that raises what it is told to."""

    def __init__(self, error):
        self.error = error

    def write(self, sweep_id, batch, *, patience_s):
        raise self.error


@pytest.mark.parametrize("error", [StoreLocked("somebody reads"), KeyError("a fault of ours")])
async def test_trials_wait_for_no_reader_and_no_flusher_that_is_gone(error):
    flusher = Flusher(Refusing(error), "sweep", lambda line: None)
    for _ in range(2 * MOST_PENDING):
        flusher.add(trial(0))
    async with asyncio.timeout(10):
        await flusher.room()
    flusher._task.cancel()
    await asyncio.gather(flusher._task, return_exceptions=True)


class Slow:
    """A store that notes what it is given at once, when it is told to go on."""

    def __init__(self):
        self.written = []
        self.go_on = threading.Event()

    def write(self, sweep_id, batch, *, patience_s):
        self.go_on.wait()
        self.written.append(len(batch))
        return []


async def test_long_replies_wait_and_are_written_in_parts_of_bounded_size():
    store = Slow()
    flusher = Flusher(store, "sweep", lambda line: None)
    while flusher._bytes <= MOST_PENDING_BYTES:
        await asyncio.wait_for(flusher.room(), 1)
        flusher.add(trial(10 * MB))
    waiting = asyncio.create_task(flusher.room())
    await asyncio.sleep(0.01)
    assert not waiting.done()
    store.go_on.set()
    async with asyncio.timeout(10):
        await waiting
    await flusher.close()
    assert sum(store.written) == MOST_PENDING_BYTES // (10 * MB) + 1
    assert max(store.written) == 3
    assert flusher._bytes == 0


async def test_what_cannot_be_stored_fills_the_memory_up_to_a_limit():
    flusher = Flusher(Refusing(StoreLocked("somebody reads")), "sweep", lambda line: None)
    text = trial(MOST_STUCK_BYTES // 4)
    for _ in range(4):
        flusher.add(text)
    await asyncio.sleep(0.01)
    flusher._task.cancel()
    await asyncio.gather(flusher._task, return_exceptions=True)
    assert flusher._problem
    assert flusher._is_full()
