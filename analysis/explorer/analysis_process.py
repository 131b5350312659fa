"""Asks the process that computes, and remembers what it answered."""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
import time
import tomllib
from collections.abc import Callable, Mapping
from concurrent.futures import Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import duckdb

from merge_runner.errors import MergeRunnerError, UsageError
from merge_runner.registry import in_use, use
from merge_runner.study.file import StudyFile
from merge_runner.study.parts import catalogue_of
from merge_runner.text_safety import first_line
from merge_runner_analysis.explorer.analysis_worker import Numbers
from merge_runner_analysis.explorer.catalogue import State, stamp_of

Request = tuple[str, ...]
REMEMBERED = 100


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


class Answering:
    """Answers about a database; what was read of it in one state is dropped in the next."""

    def __init__(self, db: Path, numbers: Callable[[Path], Numbers] = Numbers) -> None:
        self.db = db
        self._new = numbers
        self._numbers: Numbers | None = None
        self._state: State | None = None
        self._stamp: tuple[int, ...] = ()

    def read_ahead(self) -> None:
        """Read the trials; whatever is asked first begins anew, and says what is wrong."""
        self._begin(None)
        with suppress(MergeRunnerError):
            self._answer(("study",))

    def result(self, request: Request, state: State, since: float) -> Result:
        """The answer in this state; raises MergeRunnerError.

        A cell is looked up in the state that its table shows, unless a later one is wanted.
        """
        if self._state is None and self._numbers is not None and self._stamp == stamp_of(self.db):
            self._state = state
        as_shown = self._state is not None and request[0] == "cell" and not since
        if self._state != state and not as_shown:
            self._begin(state)
        made_in = self._state or state
        return Result(self._answer(request), made_in, time.time())

    def _begin(self, state: State | None) -> None:
        self._numbers = None  # which makes room first
        self._stamp = stamp_of(self.db)
        self._numbers, self._state = self._new(self.db), state

    def _answer(self, request: Request) -> dict[str, Any]:
        assert self._numbers is not None
        try:
            return self._numbers.answer(request)
        except duckdb.Error as exc:  # as where the file is replaced while it is read
            raise UsageError(f"{self.db} cannot be read: {first_line(exc)}") from exc


class Worker:
    """A process that computes, with the same study's plug-ins as this one."""

    def __init__(self, db: Path) -> None:
        self._pool = ProcessPoolExecutor(
            max_workers=1,
            mp_context=multiprocessing.get_context("spawn"),
            initializer=_begin,
            initargs=(db, in_use().text, dict(in_use().plugins)),
        )
        self._pid = self._pool.submit(os.getpid)

    def read_ahead(self) -> None:
        """Read the trials before anything is asked."""
        self._pool.submit(_read_ahead)

    def submit(self, request: Request, state: State, since: float) -> Future[Result]:
        """Compute an answer after what was asked before."""
        return self._pool.submit(_result, request, state, since)

    def close(self) -> None:
        """End it, whatever is under way."""
        self._pool.shutdown(wait=False, cancel_futures=True)
        with suppress(BrokenProcessPool, ProcessLookupError):
            os.kill(self._pid.result(), signal.SIGKILL)


def _begin(db: Path, text: str, plugins: Mapping[str, str]) -> None:
    """In the process: use the study of the explorer, whatever stands in its files by now."""
    global _answering  # noqa: PLW0603 # of a process that has no other use
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the explorer, which then ends it
    threading.Thread(target=_end_with_parent, daemon=True).start()
    if text:
        use(catalogue_of(StudyFile.model_validate(tomllib.loads(text)), text, plugins))
    _answering = Answering(db)


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    assert parent is not None
    parent.join()
    os._exit(0)


_answering: Answering


def _read_ahead() -> None:
    _answering.read_ahead()


def _result(request: Request, state: State, since: float) -> Result:
    return _answering.result(request, state, since)


class Computing:
    """Answers by request. One computation goes on at a time, the others wait for it."""

    def __init__(self, db: Path, start: Callable[[Path], Worker] = Worker) -> None:
        self.db = db
        self._start = start
        self._lock = threading.Lock()
        self._results: dict[Request, Result] = {}
        self._jobs: dict[Request, tuple[Future[Result], float]] = {}
        self._worker: Worker | None = None

    def begin(self) -> None:
        """Read the trials before anything is asked: the first page shows what is made of them."""
        with self._lock:
            self._worker = self._worker or self._start(self.db)
            self._worker.read_ahead()

    def ask(
        self, request: Request, state: State, *, since: float = 0.0, wait_s: float = 0.0
    ) -> Result | Waiting:
        """An answer made at ``since`` (s since 1970) or later, waiting at most ``wait_s`` for it.

        ``state`` is the present one; an answer made in an earlier one will do, since it says which;
        what was absent may be there in another state. Raises MergeRunnerError.
        """
        with self._lock:
            found = self._results.get(request)
            if (
                found is not None
                and found.at >= since
                and ("absent" not in found.content or found.state == state)
            ):
                return found
            if request not in self._jobs:
                self._worker = self._worker or self._start(self.db)
                made = self._worker.submit(request, state, since)
                self._jobs[request] = (made, time.monotonic())
            future, began = self._jobs[request]
        if not wait([future], timeout=wait_s).done:
            return Waiting(time.monotonic() - began)
        with self._lock:
            if self._jobs.get(request, (None,))[0] is future:
                del self._jobs[request]
            try:
                result = future.result()
            except BrokenProcessPool as exc:
                self._worker = None  # the next answer comes from another one
                raise UsageError(
                    "the computation ended without an answer; what it said stands where "
                    "`merge-runner view` was started"
                ) from exc
            self._results.pop(request, None)
            self._results[request] = result
            while len(self._results) > REMEMBERED:
                del self._results[next(iter(self._results))]
        return result

    def close(self) -> None:
        """Stop computing."""
        if self._worker is not None:
            self._worker.close()
