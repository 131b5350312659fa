"""Writes ended trials to the store in batches, in a thread, while the trials go on."""

from __future__ import annotations

import asyncio
from collections.abc import Callable

from merge_runner.errors import StoreError, StoreLocked
from merge_runner.records import TrialRecord
from merge_runner.store import Store

EVERY_S = 1.0
LOCK_PATIENCE_S = 2.0
# At the end: with a lock, which somebody will release, and with anything else, as a full disk.
LAST_LOCK_PATIENCE_S, LAST_PATIENCE_S = 60.0, 3.0


class Flusher:
    """Collects ended trials and stores them about once a second.

    What cannot be stored waits in memory while the trials go on. ``differing`` lists the trials
    that are stored already, with another result.
    """

    def __init__(self, store: Store, sweep_id: str, say: Callable[[str], None]) -> None:
        self.differing: list[str] = []
        self._store = store
        self._sweep_id = sweep_id
        self._say = say
        self._pending: list[TrialRecord] = []
        self._problem = ""
        self._locked = False
        self._closing = asyncio.Event()
        self._task = asyncio.create_task(self._run())

    def add(self, record: TrialRecord) -> None:
        """Store this trial with the next batch."""
        self._pending.append(record)

    async def close(self) -> None:
        """Store what is left; raises StoreError if that does not work after a while."""
        self._closing.set()
        await self._task
        began = asyncio.get_running_loop().time()
        while self._pending and not await self._flush():
            patience_s = LAST_LOCK_PATIENCE_S if self._locked else LAST_PATIENCE_S
            if asyncio.get_running_loop().time() - began >= patience_s:
                raise StoreError(
                    f"{len(self._pending)} trials are not stored: {self._problem}. When that is "
                    "mended, run the same command again: it writes them from the recorded replies "
                    "without a call."
                )
            await asyncio.sleep(min(EVERY_S, patience_s))

    async def _run(self) -> None:
        while not self._closing.is_set():
            try:
                async with asyncio.timeout(EVERY_S):
                    await self._closing.wait()
            except TimeoutError:
                await self._flush()

    async def _flush(self) -> bool:
        """Write one batch; False if that did not work."""
        batch, self._pending = self._pending, []
        if not batch:
            return True
        try:
            self.differing += await asyncio.to_thread(
                self._store.write, self._sweep_id, batch, patience_s=LOCK_PATIENCE_S
            )
        except StoreError as exc:
            self._pending = batch + self._pending
            self._locked = isinstance(exc, StoreLocked)
            if str(exc) != self._problem:
                self._problem = str(exc)
                self._say(f"waiting to store {len(self._pending)} trials: {exc}")
            return False
        return True
