"""Room for trials that are not stored yet."""

from __future__ import annotations

import asyncio
import threading
from dataclasses import replace

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
from merge_runner.run.flusher import (
    BATCH,
    BATCH_OF_REPLAY,
    MOST_PENDING,
    MOST_PENDING_BYTES,
    MOST_STUCK_BYTES,
    SPILLED_BYTES,
    Flusher,
)
from tests.gate import HANGS_S

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
        return {}


async def test_long_replies_wait_and_are_written_in_parts_of_bounded_size():
    store = Slow()
    flusher = Flusher(store, "sweep", lambda line: None)
    while flusher._bytes <= MOST_PENDING_BYTES:
        await asyncio.wait_for(flusher.room(), HANGS_S)
        flusher.add(trial(10 * MB))
    waiting = asyncio.create_task(flusher.room())
    await asyncio.sleep(0.01)
    assert not waiting.done()
    store.go_on.set()
    async with asyncio.timeout(HANGS_S):
        await waiting
    await flusher.close()
    assert sum(store.written) == MOST_PENDING_BYTES // (10 * MB) + 1
    assert max(store.written) == 3
    assert flusher._bytes == 0


@pytest.mark.parametrize(("batch", "written"), [(BATCH, [64, 46]), (BATCH_OF_REPLAY, [110])])
async def test_trials_that_take_no_time_are_stored_in_fewer_transactions(batch, written):
    store = Slow()
    store.go_on.set()
    flusher = Flusher(store, "sweep", lambda line: None, batch)
    for _ in range(110):
        flusher.add(trial(0))
    await flusher.close()
    assert store.written == written


class Held(Slow):
    """A store that another program holds until it is told to go on."""

    def __init__(self, path):
        super().__init__()
        self.path = path

    def write(self, sweep_id, batch, *, patience_s):
        if not self.go_on.is_set():
            raise StoreLocked("somebody reads")
        self.written.extend(record.end_time_s for record in batch)
        return {}


def long_trials(number):
    one = trial(SPILLED_BYTES // 4)
    return [replace(one, end_time_s=float(place)) for place in range(number)]


async def test_what_cannot_be_stored_is_spilled_and_stored_whole_and_in_order(tmp_path):
    store, said = Held(tmp_path / "results.duckdb"), []
    flusher = Flusher(store, "sweep", said.append)
    for record in long_trials(6):
        flusher.add(record)
        await asyncio.wait_for(flusher.room(), HANGS_S)
    async with asyncio.timeout(HANGS_S):
        while flusher._bytes > SPILLED_BYTES:
            await asyncio.sleep(0.05)
    assert flusher.left == 6
    assert flusher.problem == "6 trials wait to be stored: somebody reads"
    closing = asyncio.create_task(flusher.close())
    async with asyncio.timeout(HANGS_S):
        while "Ctrl-C ends the waiting" not in said[-1]:
            await asyncio.sleep(0.05)
        store.go_on.set()
        await closing
    assert sorted(store.written) == list(map(float, range(6)))
    assert (flusher.left, flusher._bytes, flusher.problem) == (0, 0, "")
    assert list(tmp_path.iterdir()) == []


async def test_what_can_neither_be_stored_nor_spilled_fills_the_memory_up_to_a_limit(tmp_path):
    flusher = Flusher(Held(tmp_path / "no such folder/results.duckdb"), "sweep", lambda line: None)
    text = trial(MOST_STUCK_BYTES // 4)
    for _ in range(4):
        flusher.add(text)
    async with asyncio.timeout(HANGS_S):
        while not flusher._problem:
            await asyncio.sleep(0.01)
    flusher._task.cancel()
    await asyncio.gather(flusher._task, return_exceptions=True)
    assert flusher._is_full()
