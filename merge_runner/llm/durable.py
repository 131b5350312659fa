"""Durable writes in groups, and locks, of a cache folder.

A durable write takes some milliseconds however little it writes. One for each reply would bound a
sweep to a few hundred calls a second, so writes that gather during one transaction form the next
(group commit). Locks are on open files: the kernel frees them when their holder dies.
"""

from __future__ import annotations

import asyncio
import contextlib
import fcntl
import os
import re
import sqlite3
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from itertools import repeat
from pathlib import Path
from typing import Any, TypeVar

from merge_runner.errors import UsageError

A_FEW = 16
BUSY_S = 600.0  # another process may be writing long replies to a slow disk
# Live runs share it; a release of reservations holds it exclusively.
LIVE = "live.lock"
ResultT = TypeVar("ResultT")
Rows = list[tuple[Any, ...]]
# Executes a statement in the transaction of an operation.
Execute = Callable[..., sqlite3.Cursor]
# A step of a durable transaction.
Operation = Callable[[Execute], Any]


@contextlib.contextmanager
def folder_lock(folder: Path) -> Iterator[None]:
    """Lock a folder while a file is created in it; afterwards the file's name is durable."""
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX)
        yield
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def connect(file: Path, mode: str = "ro") -> sqlite3.Connection:
    """Return a connection to an SQLite file for all threads, in a ``mode`` of SQLite's URIs.

    Run one query at a time: threads share prepared statements, and one could read another's row.
    """
    # A reader that may not write would leave the empty journal that SQLite makes.
    is_closed = not any(Path(f"{file}-{journal}").exists() for journal in ("wal", "journal"))
    uri = f"{file.absolute().as_uri()}?mode={'rw' if is_closed else mode}"
    opened = sqlite3.connect(
        uri, uri=True, timeout=BUSY_S, isolation_level=None, check_same_thread=False
    )
    opened.execute(f"PRAGMA query_only = {mode == 'ro'}")
    return opened


class GroupWriter:
    """Group commit: a thread passes all gathered operations to ``run``.

    ``run`` returns their results, and the error of each that failed.
    """

    def __init__(self, run: Callable[[Sequence[Operation]], list[Any]]) -> None:
        self._run = run
        self._thread = ThreadPoolExecutor(max_workers=1)
        self._waiting: list[tuple[Operation, asyncio.Future[Any]]] = []
        self._writing: asyncio.Task[None] | None = None

    def close(self, at_end: Callable[[], None]) -> None:
        """Wait for the group that is being written, call ``at_end`` in the thread, and end it."""
        self._thread.submit(at_end).result()
        self._thread.shutdown()

    def write(self, operation: Callable[[Execute], ResultT]) -> asyncio.Future[ResultT]:
        """Return the future result of an operation, set once it is durable."""
        future = asyncio.get_running_loop().create_future()
        self._waiting.append((operation, future))
        if self._writing is None or self._writing.done():
            self._writing = asyncio.create_task(self._write_all())
        return future

    async def _write_all(self) -> None:
        """Write in each group all that has gathered while the previous one was written."""
        loop = asyncio.get_running_loop()
        while self._waiting:
            operations, futures = zip(*self._waiting, strict=True)
            self._waiting = []
            # In a thread, since the event loop must not wait for a disk.
            written = loop.run_in_executor(self._thread, self._run, operations)
            await asyncio.wait([written])
            failed = written.exception()
            results = repeat(failed) if failed else written.result()
            for number, (future, result) in enumerate(zip(futures, results, strict=False), 1):
                if number % A_FEW == 0:  # or all callers would go on in one round of the loop
                    await asyncio.sleep(0)
                if future.cancelled():
                    continue
                if isinstance(result, BaseException):
                    future.set_exception(result)
                else:
                    future.set_result(result)


class ModelLocks:
    """Locks of this run on a folder, freed by ``close``."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._files: list[int] = []

    def take(self, models: Iterable[str]) -> None:
        """Lock models for a live run; raise UsageError where another run asks one of them."""
        self._lock(LIVE, fcntl.LOCK_SH)
        for model in sorted(models):
            name = re.sub(r"[^\w. -]", "_", model)[:200] + ".lock"
            if not self._lock(name, fcntl.LOCK_EX | fcntl.LOCK_NB):
                holder = (self._folder / name).read_text(errors="replace")
                self.close()
                raise UsageError(
                    f"another merge-runner ({holder}) asks {model} with the cache {self._folder}: "
                    "wait until it has ended, or name another folder with --cache; `merge-runner "
                    "sweep A B` plays several sweeps one after the other"
                )
            os.ftruncate(self._files[-1], 0)
            os.write(self._files[-1], f"PID {os.getpid()} on {os.uname().nodename}".encode())

    def take_all(self) -> bool:
        """Lock out live runs; return False if one is under way."""
        return self._lock(LIVE, fcntl.LOCK_EX | fcntl.LOCK_NB)

    def close(self) -> None:
        """Free all locks."""
        while self._files:
            os.close(self._files.pop())

    def _lock(self, name: str, flags: int) -> bool:
        try:
            file = os.open(self._folder / name, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
            self._files.append(file)
            fcntl.flock(file, flags)
        except BlockingIOError:
            os.close(self._files.pop())
            return False
        except OSError as exc:
            self.close()
            raise UsageError(
                f"the cache {self._folder} cannot be shared safely: {name} cannot be locked "
                f"({exc.strerror}). Name a folder on a local disk with --cache"
            ) from exc
        return True
