"""Has answers computed by a process of its own, one after another, and remembers them.

pandas and the fits hold a Python process for seconds, and no page may wait for another's numbers.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
import time
import tomllib
from collections.abc import Callable, Mapping
from concurrent.futures import Executor, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from merge_runner.errors import MergeRunnerError
from merge_runner.registry import in_use, use
from merge_runner.study.file import StudyFile
from merge_runner.study.parts import catalogue_of
from merge_runner_analysis.web.answers import Request, answer, cached_answer

REMEMBERED = 100
# While a run goes on the database changes all the time: an answer stands for some seconds.
STANDS_S = 20.0
BROKEN = (
    "the computation ended without an answer; what it said stands where `merge-runner view` was "
    "started"
)


@dataclass(frozen=True, slots=True)
class Job:
    """A computation, of a state of the database (its stamp), begun at a time (s since 1970).

    ``before`` computes an earlier state, whose answer stands until this one is there; the
    database has changed since where it is ``older``.
    """

    request: Request
    answer: Future[dict[str, Any]]
    state: tuple[int, ...]
    begun: float
    before: Job | None = None
    older: bool = False

    @property
    def what(self) -> str:
        """The computation in words."""
        match self.request:
            case ["comparison", one, other, *_]:
                return f"the comparison of {one} and {other}"
            case ["cell", table, *_]:
                return f"the trials behind a number of the table {table}"
            case [kind, name, *_]:
                return f"the {kind} {name}"
            case _:
                return f"the {' '.join(self.request)} of the results"

    @property
    def elapsed_s(self) -> float:
        """Time since the start."""
        return time.time() - self.begun

    @property
    def content(self) -> dict[str, Any] | None:
        """The answer; None while it is not there, and where there will be none."""
        is_there = self.answer.done() and self.answer.exception() is None
        return self.answer.result() if is_there else None

    @property
    def failure(self) -> str:
        """Reason for a missing answer; empty while there may be one."""
        exc = self.answer.exception() if self.answer.done() else None
        return BROKEN if isinstance(exc, BrokenProcessPool) else str(exc or "")


class Computing:
    """Answers by request. Computations run one at a time."""

    def __init__(
        self,
        db: Path,
        compute: Callable[[Path, Request], dict[str, Any]] = answer,
        start: Callable[[], Executor] | None = None,
        look_up: Callable[[Path, Request], dict[str, Any] | None] = cached_answer,
    ) -> None:
        """Compute by a function, in what ``start`` begins, unless ``look_up`` has the answer."""
        self.db = db
        self._compute, self._start, self._look_up = compute, start or processes, look_up
        self._lock = threading.Lock()
        self._jobs: dict[Request, Job] = {}
        self._executor: Executor | None = None

    def ask(self, request: Request, state: tuple[int, ...], wait_s: float | None = 0.0) -> Job:
        """Return a computation, waiting at most ``wait_s`` for its answer, or as long as it takes.

        ``state`` is the present one. An answer of an earlier state is given while a newer one is
        computed, but what was absent then may be there now, and no failure stays.
        """
        with self._lock:
            job = self._jobs.pop(request, None)
            content = job.content if job else None
            is_absent = content is not None and "absent" in content
            if job is None or (
                content is not None
                and job.state != state
                and (is_absent or job.elapsed_s > STANDS_S)
            ):
                before = None if job is None or is_absent else replace(job, before=None)
                job = Job(request, self._submit(request), state, time.time(), before)
            self._jobs[request] = job
            if len(self._jobs) > REMEMBERED:
                del self._jobs[next(iter(self._jobs))]
        wait([job.answer], timeout=wait_s)
        if not job.answer.done():
            job = job.before or job
        elif failure := job.answer.exception():
            with self._lock:
                self._jobs.pop(request, None)
            if not isinstance(failure, MergeRunnerError | BrokenProcessPool):
                raise failure
        return replace(job, older=job.state != state)

    def _submit(self, request: Request) -> Future[dict[str, Any]]:
        if (known := self._look_up(self.db, request)) is not None:
            done = Future[dict[str, Any]]()
            done.set_result(known)
            return done
        if self._executor is not None:
            with suppress(BrokenProcessPool):  # another process takes its place
                return self._executor.submit(self._compute, self.db, request)
        self._executor = self._start()
        self._pid = self._executor.submit(os.getpid)
        return self._executor.submit(self._compute, self.db, request)

    def close(self) -> None:
        """Stop computing at once: the present computation could take minutes."""
        if self._executor is None:
            return
        with suppress(BrokenProcessPool, ProcessLookupError):
            if (pid := self._pid.result()) != os.getpid():
                os.kill(pid, signal.SIGKILL)
        # A thread that still ended while the program exits could make it fail.
        self._executor.shutdown(cancel_futures=True)


def processes(number: int = 1) -> ProcessPoolExecutor:
    """Return a pool of processes with the same study's plug-ins as this one."""
    return ProcessPoolExecutor(
        max_workers=number,
        mp_context=multiprocessing.get_context("spawn"),
        initializer=_begin,
        initargs=(in_use().text, dict(in_use().plugins)),
    )


def _begin(text: str, plugins: Mapping[str, str]) -> None:
    """Use the study of the explorer, whatever stands in its files by now."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the explorer, which then ends it
    threading.Thread(target=_end_with_parent, daemon=True).start()
    if text:
        use(catalogue_of(StudyFile.model_validate(tomllib.loads(text)), text, plugins))


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    assert parent is not None
    parent.join()
    os._exit(0)
