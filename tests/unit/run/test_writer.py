"""Capacity for trials that are not stored yet."""

import asyncio
import threading
from dataclasses import replace

import pytest

from merge_runner.errors import StoreError, StoreLocked
from merge_runner.records import Attempt, ChatReply, Decision
from merge_runner.run.writer import LIVE_BATCH_BYTES, MOST_PENDING, MOST_PENDING_BYTES, TrialWriter
from merge_runner.trial_records import DecisionRow, TrialRecord
from tests.support.gate import HANGS_S
from tests.support.specs import spec_of

SPEC = spec_of()
HELD = StoreLocked("somebody reads")
MB = 2**20


class Scripted:
    """A store that raises what it is told to, or notes what it is given once it may go on."""

    def __init__(self, error=None):
        self.error, self.written, self.go_on = error, [], threading.Event()
        if error:
            self.go_on.set()

    def write(self, sweep_id, batch, *, patience_s):
        self.go_on.wait()
        if self.error:
            raise self.error
        self.written.append([record.spec.order for record in batch])
        return {}

    @property
    def orders(self):
        return [order for batch in self.written for order in batch]


def writer_of(store, say=lambda line: None, **options):
    return TrialWriter(store, "sweep", say, **options)


@pytest.mark.parametrize("error", [StoreLocked("somebody reads"), KeyError("a fault of ours")])
async def test_trials_wait_for_no_reader_and_no_flusher_that_is_gone_and_what_is_dropped_is_told(
    error,
):
    store = Scripted(error)
    writer = writer_of(store)
    for order in range(2 * MOST_PENDING):
        writer.add(ended(order))
    await asyncio.wait_for(writer.wait_for_capacity(), HANGS_S)
    store.error = StoreError("the disk is full")
    said = r"the disk is full\. When|the writer of results has failed \(Key"
    with pytest.raises(StoreError, match=f"^{2 * MOST_PENDING} trials are not stored: ({said})"):
        await asyncio.wait_for(writer.close(), HANGS_S)


async def test_long_replies_wait_and_are_written_in_parts_of_bounded_size():
    store = Scripted()
    writer = writer_of(store, is_live=False)
    most = MOST_PENDING_BYTES // (5 * MB) + 1
    for _ in range(most):
        await asyncio.wait_for(writer.wait_for_capacity(), HANGS_S)
        writer.add(ended(size=5 * MB))
    waiting = asyncio.create_task(writer.wait_for_capacity())
    await asyncio.sleep(0.01)
    assert not waiting.done()
    store.go_on.set()
    async with asyncio.timeout(HANGS_S):
        await waiting
    await writer.close()
    assert (len(store.orders), max(map(len, store.written))) == (most, 2)


@pytest.mark.parametrize(
    ("is_live", "trials", "size", "written"),
    # Of live ones the last may be a quarter larger.
    [(False, 600, 0, [512, 88]), (True, 5, LIVE_BATCH_BYTES // 3, [2, 3])],
)
async def test_trials_are_stored_in_few_transactions_and_live_ones_in_short_ones(
    is_live, trials, size, written
):
    store = Scripted()
    store.go_on.set()
    writer = writer_of(store, is_live=is_live)
    for _ in range(trials):
        writer.add(ended(size=size))
    await writer.close()
    assert [*map(len, store.written)] == written


def ended(order=0, status="finished", size=0):
    """A trial whose only reply has so many bytes."""
    reply = ChatReply("", "ok", None, (Attempt(1, "ok", reply="x" * size),), 0)
    decision = DecisionRow(0, 0.0, "left", Decision((), (), reply=reply))
    return TrialRecord(replace(SPEC, order=order), status, None, 1.0, None, (), (decision,))


async def is_refused(writer):
    """Wait until storing has failed."""
    async with asyncio.timeout(HANGS_S):
        while not writer.problem:
            await asyncio.sleep(0.01)


@pytest.mark.parametrize("known", [True, False])
async def test_while_the_database_is_held_512_trials_stay_in_memory_and_the_failed_ones(known):
    store, said = Scripted(HELD), []
    writer = writer_of(store, said.append)
    writer.add(ended(0))
    if known:
        await is_refused(writer)
    for order in range(1, 1000):
        writer.add(ended(order, "failed" if order in (600, 700) else "collided"))
        await asyncio.wait_for(writer.wait_for_capacity(), HANGS_S)
    await is_refused(writer)
    kept = [*range(512), 600, 700]
    dropped = [order for order in range(1000) if order not in kept]
    assert [spec.order for spec in writer.dropped] == dropped
    assert writer.problem == "1000 trials wait to be stored: somebody reads"
    closing = asyncio.create_task(writer.close())
    async with asyncio.timeout(HANGS_S):
        while "1000 trials wait to be stored: somebody reads. Ctrl-C ends" not in str(said):
            await asyncio.sleep(0.05)
        store.error = None
        await closing
    assert store.orders == kept
    assert (writer.left, writer.problem) == (486, "")
    # They may come again, and are stored by the next call.
    writer.add(ended(512))
    await asyncio.wait_for(writer.close(), HANGS_S)
    assert store.orders[-1] == 512


@pytest.mark.parametrize(
    ("sizes", "kept"),
    [([MOST_PENDING_BYTES // 4] * 6, [0, 1, 2]), ([MOST_PENDING_BYTES + 1, 0], [0])],
)
async def test_while_the_database_is_held_replies_stay_in_memory_up_to_a_bound(sizes, kept):
    """The first one always."""
    store = Scripted(HELD)
    writer = writer_of(store)
    for order, size in enumerate(sizes):
        writer.add(ended(order, size=size))
        await is_refused(writer)
    store.error = None
    await writer.close()
    assert store.orders == kept
    assert [spec.order for spec in writer.dropped] == [*range(len(kept), len(sizes))]
