"""Writes ended trials to the store in batches, in a thread, while the trials go on."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import sys
from collections.abc import Callable
from itertools import accumulate, chain

from merge_runner.errors import StoreError, StoreLocked
from merge_runner.records import TrialRecord
from merge_runner.results.store import Store
from merge_runner.run.spill import Spill

EVERY_S = 1.0
BATCH = 64
"""Trials in one transaction: few enough that a reader gets its turn soon."""
BATCH_OF_REPLAY = 4 * BATCH
"""Of trials that take no time: a transaction costs as much as storing dozens of them."""
MOST_PENDING = 8 * BATCH
BATCH_BYTES, MOST_PENDING_BYTES = 2**25, 2**27
# While storing fails, as when another program holds the file: how many bytes may wait in memory
# before they are spilled, and before trials wait because spilling fails, too.
SPILLED_BYTES, MOST_STUCK_BYTES = 2**27, 2**29
LOCK_PATIENCE_S = 2.0
# How long the end of a sweep retries what is no lock, such as a full disk. A lock is waited for.
LAST_PATIENCE_S = 3.0


AGAIN = (
    "When that is fixed, run the same command again: it writes them from the recorded replies "
    "without a call."
)
LOG = logging.getLogger(__name__)


def size_of(record: TrialRecord) -> int:
    """The bytes of a trial's replies, which are most of it."""
    replies = (row.decision.reply for row in record.decisions if row.decision.reply)
    calls = chain((reply.attempts for reply in replies), (c.attempts for c in record.failed_calls))
    return sum(sys.getsizeof(attempt.reply) for attempt in chain.from_iterable(calls))


class Flusher:
    """Collects ended trials and stores them about once a second.

    Trials that cannot be stored wait in memory, and many of them in a file beside the database,
    while others are played; where storing is merely slow, new trials wait for it. ``differing``
    maps trials that were already stored with other values to the columns that differ.
    """

    def __init__(
        self, store: Store, sweep_id: str, say: Callable[[str], None], batch: int = BATCH
    ) -> None:
        self.differing: dict[str, list[str]] = {}
        self._store = store
        self._sweep_id = sweep_id
        self._say = say
        self._batch = batch
        self._pending: list[TrialRecord] = []
        self._bytes = 0
        self._spill = Spill()
        self._problem: StoreError | None = None
        self._said = ""
        self._closing = False
        self._awake, self._tried = asyncio.Event(), asyncio.Event()
        self._task = asyncio.create_task(self._run())

    def add(self, record: TrialRecord) -> None:
        """Store this trial with the next batch."""
        self._pending.append(record)
        self._bytes += size_of(record)
        if len(self._pending) >= self._batch or self._bytes >= BATCH_BYTES:
            self._awake.set()

    async def room(self) -> None:
        """Wait while too much is still to be stored, unless storing has ended."""
        while self._is_full() and not self._task.done():
            self._tried.clear()
            await self._tried.wait()

    def _is_full(self) -> bool:
        if self._problem is not None:
            return self._bytes > MOST_STUCK_BYTES
        return len(self._pending) > MOST_PENDING or self._bytes > MOST_PENDING_BYTES

    @property
    def left(self) -> int:
        """How many trials are not stored yet."""
        return len(self._pending) + self._spill.trials

    @property
    def problem(self) -> str:
        """Why trials are not stored, as a line of text; empty where nothing is wrong."""
        if self._problem is None:
            return ""
        what = f"{self.left} trials wait" if self.left else "how the sweep ended waits"
        return f"{what} to be stored: {self._problem}"

    async def close(self) -> None:
        """Store what is left, and leave the database reachable.

        Waits for a program that holds it as long as that does; raises StoreError for anything else
        that lasts.
        """
        self._closing = True
        self._awake.set()
        await self._task
        loop = asyncio.get_running_loop()
        began, waiting = loop.time(), False
        while not await self._flush() or self.left:
            if isinstance(self._problem, StoreLocked):
                if not waiting:
                    self._say(
                        f"the playing has ended; {self.problem}. Ctrl-C ends the waiting: all "
                        "replies are in the cache"
                    )
                waiting = True
            elif not self.left:
                return  # whoever opens the database next will say what is wrong with it
            elif self._problem and loop.time() - began >= LAST_PATIENCE_S:
                raise StoreError(f"{self.left} trials are not stored: {self._problem}. {AGAIN}")
            if self._problem:
                await asyncio.sleep(EVERY_S)

    async def _run(self) -> None:
        while not self._closing:
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(EVERY_S):
                    await self._awake.wait()
            self._awake.clear()
            while self.left and not self._closing and await self._flush():
                continue

    async def _flush(self) -> bool:
        """Write one batch, which may be empty; False if that did not work."""
        if not self._pending and self._spill.trials and self._problem is None:
            taken = await asyncio.to_thread(self._spill.take)
            self._bytes += sum(map(size_of, taken))
            self._pending = taken + self._pending
        sizes = accumulate(map(size_of, self._pending[: self._batch]))
        # At least one: a single trial may be larger than a batch should be.
        number = max(1, sum(size <= BATCH_BYTES for size in sizes))
        # It stays in front until it is stored: others are added behind it meanwhile.
        batch = self._pending[:number]
        # In a thread, since DuckDB waits for the file's lock and for the disk; the trials go on.
        try:
            self.differing |= await asyncio.to_thread(
                self._store.write, self._sweep_id, batch, patience_s=LOCK_PATIENCE_S
            )
        except StoreError as exc:
            self._problem = exc
            if self.left and str(exc) != self._said:  # it is tried again every second
                self._said = str(exc)
                self._say(f"the sweep goes on; {self.problem}")
            if self._bytes > SPILLED_BYTES:
                await self._spill_pending()
            return False
        else:
            self._problem = None
            del self._pending[: len(batch)]
            self._bytes -= sum(map(size_of, batch))
            return True
        finally:
            self._tried.set()

    async def _spill_pending(self) -> None:
        """Move the trials in memory to the file, unless that cannot be written either."""
        for _ in range(0, len(self._pending), BATCH):
            batch = self._pending[:BATCH]
            try:
                await asyncio.to_thread(self._spill.put, batch, self._store.path.parent)
            except OSError as exc:
                LOG.debug("trials that wait to be stored stay in memory: %s", exc)
                return
            # Others were added meanwhile, behind these.
            del self._pending[: len(batch)]
            self._bytes -= sum(map(size_of, batch))
