"""Asks the process that computes, and remembers what it answered."""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
import time
from collections.abc import Callable
from concurrent.futures import Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from merge_runner.errors import UsageError
from merge_runner.registry import in_use
from merge_runner_analysis.explorer import analysis_worker
from merge_runner_analysis.explorer.analysis_worker import Request

REMEMBERED = 100


@dataclass(frozen=True, slots=True)
class Job:
    """A computation, of a state of the database (its stamp), begun at a time (s since 1970)."""

    answer: Future[dict[str, Any]]
    state: tuple[int, ...]
    at: float

    @property
    def content(self) -> dict[str, Any] | None:
        """The answer; None while it is not there, and where there will be none."""
        is_there = self.answer.done() and self.answer.exception() is None
        return self.answer.result() if is_there else None


class Worker:
    """A process that computes, with the same study's plug-ins as this one."""

    def __init__(self, db: Path) -> None:
        self._pool = ProcessPoolExecutor(
            max_workers=1,
            mp_context=multiprocessing.get_context("spawn"),
            initializer=analysis_worker.begin,
            initargs=(db, in_use().text, dict(in_use().plugins)),
        )
        self._pid = self._pool.submit(os.getpid)

    def submit(self, request: Request) -> Future[dict[str, Any]]:
        """Compute an answer after what was asked before."""
        return self._pool.submit(analysis_worker.answer, request)

    def close(self) -> None:
        """End it, whatever is under way."""
        self._pool.shutdown(wait=False, cancel_futures=True)
        with suppress(BrokenProcessPool, ProcessLookupError):
            os.kill(self._pid.result(), signal.SIGKILL)


class Computing:
    """Answers by request. One computation goes on at a time, the others wait for it."""

    def __init__(self, db: Path, start: Callable[[Path], Worker] = Worker) -> None:
        self.db = db
        self._start = start
        self._lock = threading.Lock()
        self._jobs: dict[Request, Job] = {}
        self._worker: Worker | None = None

    def ask(
        self,
        request: Request,
        state: tuple[int, ...],
        *,
        anew: bool = False,
        wait_s: float = 0.0,
    ) -> Job:
        """A computation, waiting at most ``wait_s`` for its answer; raises MergeRunnerError.

        ``state`` is the present one. An answer of an earlier one will do, since it says which,
        unless it is wanted ``anew``; what was absent may be there in another state.
        """
        with self._lock:
            job = self._jobs.get(request)
            content = job.content if job else None
            if job is None or (
                content is not None and job.state != state and (anew or "absent" in content)
            ):
                job = Job(self._submit(request), state, time.time())
                self._jobs.pop(request, None)
                self._jobs[request] = job
                if len(self._jobs) > REMEMBERED:
                    del self._jobs[next(iter(self._jobs))]
        wait([job.answer], timeout=wait_s)
        if not job.answer.done() or (failure := job.answer.exception()) is None:
            return job
        with self._lock:  # no failure stays
            if self._jobs.get(request) is job:
                del self._jobs[request]
        if isinstance(failure, BrokenProcessPool):
            raise UsageError(
                "the computation ended without an answer; what it said stands where "
                "`merge-runner view` was started"
            ) from failure
        raise failure

    def _submit(self, request: Request) -> Future[dict[str, Any]]:
        if self._worker is not None:
            with suppress(BrokenProcessPool):  # another process takes its place
                return self._worker.submit(request)
        self._worker = self._start(self.db)
        return self._worker.submit(request)

    def close(self) -> None:
        """Stop computing."""
        if self._worker is not None:
            self._worker.close()
