"""Stores the trials of a run that have ended, while others are played."""

from __future__ import annotations

import asyncio
import sys
import traceback
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from itertools import accumulate
from pathlib import Path

from merge_runner.errors import StoreError, StoreLocked
from merge_runner.results.rows import TrialKey
from merge_runner.results.store import Store
from merge_runner.text_safety import one_line
from merge_runner.trial_records import TrialRecord, TrialSpec

# Between two transactions other programs can open the file.
EVERY_S, POLL_S = 1.0, 0.06
REPLAY_EVERY_S = 5.0  # nothing is lost if it is killed, and few full transactions cost least
# Trials in one transaction, which costs as much as storing dozens of them; and in memory while
# storing fails, as when another program holds the file.
BATCH = 512
MOST_PENDING = 3 * BATCH // 2
BATCH_BYTES = 3 * 2**22
MOST_PENDING_BYTES = 3 * BATCH_BYTES // 2
LIVE_BATCH_BYTES = 2**22  # some 1,000 decisions: a reader waits for about 0.1 s
DECISION_BYTES = 2_000  # with its share of the states
LOCK_PATIENCE_S = 2.0
AGAIN = (
    "When that is fixed, run the same command again: it writes them from the recorded replies "
    "without a call."
)


class TrialWriter:
    """Writer of ended trials, in batches: about once a second, in a replay when a batch is full.

    While storing fails, trials beyond a batch are dropped and others are played; where storing is
    merely slow, new trials wait for it. ``dropped`` trials can be played again from the recorded
    replies; failed ones cannot, and stay in memory. ``differing`` maps the keys of trials that were
    already stored with other values to the columns that differ. After an error that is no
    StoreError it is ``broken``: it writes nothing more, and calls ``on_break`` once.
    """

    def __init__(
        self,
        store: Store,
        sweep_id: str,
        say: Callable[[str], None],
        *,
        is_live: bool = True,
    ) -> None:
        self.differing: dict[TrialKey, list[str]] = {}
        self.dropped: list[TrialSpec] = []
        self.broken = False
        self.on_break: Callable[[], object] = lambda: None
        self._store = store
        self._sweep_id = sweep_id
        self._say = say
        self._batch_bytes = LIVE_BATCH_BYTES if is_live else BATCH_BYTES
        self._every_s = EVERY_S if is_live else REPLAY_EVERY_S
        self._pending: list[tuple[TrialRecord, int]] = []  # with their bytes
        self._bytes = 0  # of all of them
        self._problem: StoreError | None = None
        self._closing = asyncio.Event()
        self._task = asyncio.create_task(self._run())

    def add(self, record: TrialRecord) -> None:
        """Store this trial with the next batch, or drop it while storing fails."""
        attempts = [attempt for call in record.calls for attempt in call.attempts]
        bytes_of_replies = sum([sys.getsizeof(attempt.reply) for attempt in attempts])
        size = bytes_of_replies + DECISION_BYTES * len(record.decisions)
        self._pending.append((record, size))
        self._bytes += size
        if self._problem is not None:
            self._drop_excess()

    async def wait_for_capacity(self) -> None:
        """Wait while too much is still to be stored, unless storing fails or has ended."""
        while self._problem is None and not self._task.done():
            if len(self._pending) <= MOST_PENDING and self._bytes <= MOST_PENDING_BYTES:
                return
            await asyncio.sleep(POLL_S)

    @property
    def left(self) -> int:
        """The number of trials that are not stored yet."""
        return len(self._pending) + len(self.dropped)

    @property
    def problem(self) -> str:
        """The reason why trials are not stored, as text; empty where nothing is wrong."""
        if self._problem is None:
            return ""
        waiting = f"{self.left} trials wait" if self.left else "how the sweep ended waits"
        return f"{waiting} to be stored: {self._problem}"

    async def close(self) -> None:
        """Store the trials in memory, and leave the database reachable.

        Waits as long as another program holds it; raises StoreError for anything else.
        More trials may be added later, and stored by the next call.
        """
        self._closing.set()
        await self._task
        is_announced = False
        while not await self._flush() or self._pending:
            if isinstance(self._problem, StoreLocked):
                if not is_announced:
                    self._say(
                        f"the playing has ended; {self.problem}. Ctrl-C ends the waiting: all "
                        "replies are in the cache"
                    )
                is_announced = True
                await asyncio.sleep(EVERY_S)
            elif self._problem and self.left:
                raise StoreError(f"{self.left} trials are not stored: {self._problem}. {AGAIN}")
            elif self._problem:
                return  # the next command that opens the database reports it

    async def _run(self) -> None:
        clock_s = asyncio.get_running_loop().time
        flushed_s = clock_s()
        while not self._closing.is_set():
            with suppress(TimeoutError):
                async with asyncio.timeout(POLL_S):
                    await self._closing.wait()
            is_much = len(self._pending) >= BATCH or self._bytes >= self._batch_bytes
            if self._pending and (is_much or clock_s() - flushed_s >= self._every_s):
                flushed_s = clock_s()
                await self._flush()

    async def _flush(self) -> bool:
        """Write one batch, which may be empty; False if that did not work."""
        if self.broken:
            return False
        sizes = accumulate(size for _, size in self._pending[:BATCH])
        # The last batch may be larger, rather than leave few trials to a further transaction.
        is_last = self._closing.is_set() and self._bytes <= 1.25 * self._batch_bytes
        most_bytes = self._bytes if is_last else self._batch_bytes
        # At least one: a single trial may be larger than a batch should be.
        number = max(1, sum(size <= most_bytes for size in sizes))
        # It stays in front until it is stored: others are added behind it meanwhile.
        batch = [record for record, _ in self._pending[:number]]
        # In a thread, since DuckDB waits for the file's lock and for the disk.
        write = partial(self._store.write, self._sweep_id, batch, patience_s=LOCK_PATIENCE_S)
        writing = asyncio.create_task(asyncio.to_thread(write))
        await asyncio.wait([writing])
        if (error := writing.exception()) is not None:
            self._fail(error)
            return False
        self.differing |= writing.result()
        self._problem = None
        self._bytes -= sum(size for _, size in self._pending[: len(batch)])
        del self._pending[: len(batch)]
        return True

    def _fail(self, error: BaseException) -> None:
        if isinstance(error, StoreError):
            self._problem = error
        else:
            place = traceback.extract_tb(error.__traceback__)[-1]
            self._problem = StoreError(
                f"the writer of results has failed ({one_line(repr(error))} in "
                f"{Path(place.filename).name}, line {place.lineno})"
            )
            self.broken = True
            self.on_break()
        self._drop_excess()

    def _drop_excess(self) -> None:
        """Drop the newest trials beyond what may wait, which are in no batch under way."""
        pending, self._pending, self._bytes = self._pending, [], 0
        for record, size in pending:
            is_much = len(self._pending) >= BATCH or self._bytes + size > MOST_PENDING_BYTES
            if is_much and self._pending and record.status != "failed":
                self.dropped.append(record.spec)
            else:
                self._pending.append((record, size))
                self._bytes += size
