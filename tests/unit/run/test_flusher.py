"""Room for trials that are not stored yet."""

from __future__ import annotations

import asyncio
import threading
from dataclasses import replace

import pytest

from merge_runner.errors import StoreError, StoreLocked
from merge_runner.records import Attempt, ChatReply, Decision, DecisionRow, TrialRecord
from merge_runner.run.local_runner import MOST_PENDING, MOST_PENDING_BYTES, Flusher
from tests.support.gate import HANGS_S
from tests.support.specs import spec_of

SPEC = spec_of()
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
    store = Refusing(error)
    flusher = Flusher(store, "sweep", lambda line: None)
    for _ in range(2 * MOST_PENDING):
        flusher.add(trial(0))
    await asyncio.wait_for(flusher.room(), HANGS_S)
    store.error = StoreError("that is the end")
    with pytest.raises(StoreError):
        await asyncio.wait_for(flusher.close(), HANGS_S)


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
    most = MOST_PENDING_BYTES // (5 * MB) + 1
    for _ in range(most):
        await asyncio.wait_for(flusher.room(), HANGS_S)
        flusher.add(trial(5 * MB))
    waiting = asyncio.create_task(flusher.room())
    await asyncio.sleep(0.01)
    assert not waiting.done()
    store.go_on.set()
    async with asyncio.timeout(HANGS_S):
        await waiting
    await flusher.close()
    assert (sum(store.written), max(store.written)) == (most, 3)


async def test_trials_are_stored_in_few_transactions():
    store = Slow()
    store.go_on.set()
    flusher = Flusher(store, "sweep", lambda line: None)
    for _ in range(300):
        flusher.add(trial(0))
    await flusher.close()
    assert store.written == [256, 44]


class Held(Slow):
    """A store that another program holds until it is told to go on."""

    def write(self, sweep_id, batch, *, patience_s):
        if not self.go_on.is_set():
            raise StoreLocked("somebody reads")
        self.written.extend(record.spec.order for record in batch)
        return {}


def ended(order, status="finished", size=0):
    return replace(trial(size), spec=replace(SPEC, order=order), status=status)


async def is_refused(flusher):
    """Wait until storing has failed."""
    async with asyncio.timeout(HANGS_S):
        while not flusher.problem:
            await asyncio.sleep(0.01)


@pytest.mark.parametrize("known", [True, False])
async def test_while_the_database_is_held_256_trials_stay_in_memory_and_the_failed_ones(known):
    store, said = Held(), []
    flusher = Flusher(store, "sweep", said.append)
    flusher.add(ended(0))
    if known:
        await is_refused(flusher)
    for order in range(1, 500):
        flusher.add(ended(order, "failed" if order in (300, 400) else "collided"))
        await asyncio.wait_for(flusher.room(), HANGS_S)
    await is_refused(flusher)
    assert [spec.order for spec in flusher.dropped] == [*range(256, 300), *range(301, 400),
                                                        *range(401, 500)]  # fmt: skip
    assert flusher.problem == "500 trials wait to be stored: somebody reads"
    closing = asyncio.create_task(flusher.close())
    async with asyncio.timeout(HANGS_S):
        while "500 trials wait to be stored: somebody reads. Ctrl-C ends" not in str(said):
            await asyncio.sleep(0.05)
        store.go_on.set()
        await closing
    assert store.written == [*range(256), 300, 400]
    assert (flusher.left, flusher.problem) == (242, "")
    # They may come again, and are stored by the next call.
    flusher.add(ended(256))
    await asyncio.wait_for(flusher.close(), HANGS_S)
    assert store.written[-1] == 256


async def test_while_the_database_is_held_a_first_long_reply_stays_always():
    store = Held()
    flusher = Flusher(store, "sweep", lambda line: None)
    flusher.add(ended(0, size=MOST_PENDING_BYTES + 1))
    await is_refused(flusher)
    flusher.add(ended(1))
    assert [spec.order for spec in flusher.dropped] == [1]
    store.go_on.set()
    await flusher.close()
    assert store.written == [0]


async def test_while_the_database_is_held_replies_stay_in_memory_up_to_a_bound():
    store = Held()
    flusher = Flusher(store, "sweep", lambda line: None)
    for order in range(6):
        flusher.add(ended(order, size=MOST_PENDING_BYTES // 4))
        await is_refused(flusher)
    store.go_on.set()
    await flusher.close()
    assert store.written == [0, 1, 2]
    assert [spec.order for spec in flusher.dropped] == [3, 4, 5]


async def test_what_is_dropped_counts_as_not_stored_where_the_disk_is_full():
    flusher = Flusher(Refusing(StoreError("the disk is full")), "sweep", lambda line: None)
    for order in range(300):
        flusher.add(ended(order))
    with pytest.raises(StoreError, match=r"^300 trials are not stored: the disk is full\. When"):
        await asyncio.wait_for(flusher.close(), HANGS_S)
