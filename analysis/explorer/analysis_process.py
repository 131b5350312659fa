"""Asks the process that computes, and remembers what it answered."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from analysis.explorer.catalogue import State, stamp_of
from analysis.explorer.child import Child, Ended, NoAnswer
from merge_runner.errors import MergeRunnerError

Request = tuple[str, ...]
REMEMBERED = 100
# Nobody has to wait for more: an export waits so long, and the process is killed then.
LONGEST_S = 3600.0
MOST_BYTES = 2**30


@dataclass(frozen=True, slots=True)
class Result:
    """An answer, the state of the database that it describes, and when it was made (s since 1970).

    ``content`` has ``absent`` where no table has what was asked for.
    """

    content: dict[str, Any]
    state: State
    at: float


@dataclass(frozen=True, slots=True)
class Waiting:
    """There is no answer yet."""

    elapsed_s: float


def worker(db: Path) -> Child:
    """The process that computes, with the same study's plug-ins as this one; raises NoAnswer."""
    child = Child("analysis.explorer.analysis_worker", str(db))
    child.give_study()
    return child


class Computing:
    """Answers by request. One computation goes on at a time, the others wait for it."""

    def __init__(self, db: Path, start: Callable[[Path], Child] = worker) -> None:
        self.db = db
        self.start = start
        self._lock = threading.Lock()
        self._pool = ThreadPoolExecutor(max_workers=1)
        self._results: dict[Request, Result] = {}
        self._jobs: dict[Request, tuple[Future[Result], float]] = {}
        self._child: Child | None = None
        self._state: State | None = None
        self._ahead: tuple[int, ...] | None = None
        """The stamp of the database of which a process read the trials before it was asked."""
        self._closed = False

    def begin(self) -> None:
        """Read the trials before anything is asked: the first page shows what is made of them."""
        self._pool.submit(self._read_ahead)

    def ask(
        self, request: Request, state: State, *, since: float = 0.0, wait_s: float = 0.0
    ) -> Result | Waiting:
        """An answer made at ``since`` (s since 1970) or later, waiting at most ``wait_s`` for it.

        ``state`` is the present one; an answer made in an earlier one will do, since it says which.
        Raises NoAnswer.
        """
        with self._lock:
            found = self._results.get(request)
            if found is not None and found.at >= since and self._stands(found):
                return found
            if request not in self._jobs:
                made = self._pool.submit(self._run, request, state, since)
                self._jobs[request] = (made, time.monotonic())
            future, began = self._jobs[request]
        try:
            future.exception(timeout=wait_s)
        except TimeoutError:
            return Waiting(time.monotonic() - began)
        with self._lock:
            if self._jobs.get(request, (None,))[0] is future:
                del self._jobs[request]
            result = future.result()
            self._results.pop(request, None)
            self._results[request] = result
            while len(self._results) > REMEMBERED:
                del self._results[next(iter(self._results))]
        return result

    def close(self) -> None:
        """Stop computing."""
        self._closed = True
        self._pool.shutdown(wait=False, cancel_futures=True)
        if self._child is not None:
            self._child.close()

    def _stands(self, result: Result) -> bool:
        """Whether an answer still holds: what was absent may be there in another state."""
        return "absent" not in result.content or result.state == self._state

    def _read_ahead(self) -> None:
        # Whatever is asked first begins anew, and says what is wrong.
        with suppress(MergeRunnerError, NoAnswer, Ended):
            stamp = stamp_of(self.db)
            self._start().ask(("study",), seconds=LONGEST_S, most_bytes=MOST_BYTES)
            self._ahead = stamp

    def _run(self, request: Request, state: State, since: float) -> Result:
        if self._ahead is not None and self._ahead == stamp_of(self.db):
            self._state = state
        self._ahead = None
        # A cell is looked up in the state that its table shows, unless a later one is wanted.
        is_cell = self._state is not None and request[0] == "cell" and not since
        alive = self._child is not None and self._child.alive
        if not alive or not (is_cell or self._state == state):
            self._end()
            # Another process for another state: all that was made of the old one ends with it.
            self._start()
            self._state = state
        assert self._child is not None
        assert self._state is not None
        made_in = self._state
        try:
            content, _ = self._child.ask(request, seconds=LONGEST_S, most_bytes=MOST_BYTES)
        except Ended as exc:
            self._end()
            raise NoAnswer(
                f"the computation ended without an answer ({exc}); what it said stands where "
                "`merge-runner view` was started"
            ) from exc
        return Result(content, made_in, time.time())

    def _start(self) -> Child:
        self._child = self.start(self.db)
        if self._closed:
            self._end()
            raise NoAnswer("the explorer ends")
        return self._child

    def _end(self) -> None:
        if self._child is not None:
            self._child.close()
        self._child = self._state = None
