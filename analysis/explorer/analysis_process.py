"""Asks the process that computes, and remembers what it answered."""

from __future__ import annotations

import json
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

from analysis.explorer.catalogue import State

Request = tuple[str, ...]
REMEMBERED = 100
# What the fits of these tables take on their own, in s on a slow machine.
LONG_S = {"who-first": 8, "gap": 13, "indicators": 15, "ablation-qualitative": 15}


@dataclass(frozen=True, slots=True)
class Result:
    """An answer, the state of the database that it was made in, and when (s since 1970).

    It may be that what is asked for is ``absent``.
    """

    content: dict[str, Any]
    state: State
    at: float


@dataclass(frozen=True, slots=True)
class Waiting:
    """There is no answer yet."""

    elapsed_s: float


@dataclass(frozen=True, slots=True)
class Failed:
    """There will be no answer; ``text`` says why."""

    text: str


class Failure(Exception):
    """A computation has failed."""


class Ended(Failure):
    """The computing process is gone."""


class Computer(Protocol):
    """The process that answers, one request after another."""

    def ask(self, request: Request) -> dict[str, Any]:
        """The answer; raises Failure."""

    def close(self) -> None:
        """End, whatever is under way."""


class Child:
    """A process that computes; it ends with this one."""

    def __init__(self, db: Path) -> None:
        # In a session of its own: an interrupt is for the server, which then ends it. Not even a
        # file of our modules' names in the working folder is run (-P).
        self._process = subprocess.Popen(  # noqa: S603 # our own program
            [sys.executable, "-P", "-m", "analysis.explorer.analysis_worker", str(db)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            encoding="utf-8",
            start_new_session=True,
        )

    def ask(self, request: Request) -> dict[str, Any]:
        """The answer; raises Failure, also where the process has ended."""
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        try:
            self._process.stdin.write(json.dumps(request) + "\n")
            self._process.stdin.flush()
            line = self._process.stdout.readline()
        except (OSError, ValueError):
            line = ""
        if not line.endswith("\n"):
            code = self._process.wait()
            raise Ended(
                f"the computation ended without an answer (exit code {code}); what it said stands "
                "where `merge-runner view` was started"
            )
        answer: dict[str, Any] = json.loads(line)
        if "failure" in answer:
            raise Failure(answer["failure"])
        return answer

    def close(self) -> None:
        """End it."""
        self._process.kill()
        self._process.wait()


class Computing:
    """Answers by request. One computation goes on at a time, the others wait for it."""

    def __init__(self, db: Path, start: Callable[[Path], Computer] = Child) -> None:
        self.db = db
        self.start = start
        self._lock = threading.Lock()
        self._pool = ThreadPoolExecutor(max_workers=1)
        self._results: dict[Request, Result] = {}
        self._jobs: dict[Request, tuple[Future[Result], float]] = {}
        self._computer: Computer | None = None
        self._state: State | None = None
        self._closed = False

    def ask(
        self, request: Request, state: State, *, since: float = 0.0, wait_s: float = 0.0
    ) -> Result | Waiting | Failed:
        """An answer made at ``since`` (s since 1970) or later, waiting at most ``wait_s`` for it.

        ``state`` is the present one; an answer of an earlier one will do, for it says so.
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
            failed = future.exception(timeout=wait_s)
        except TimeoutError:
            return Waiting(time.monotonic() - began)
        with self._lock:
            if self._jobs.get(request, (None,))[0] is future:
                del self._jobs[request]
            if isinstance(failed, Failure):
                return Failed(str(failed))
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
        if self._computer is not None:
            self._computer.close()

    def _stands(self, result: Result) -> bool:
        """What is absent may be there in the state of another process."""
        return "absent" not in result.content or result.state == self._state

    def _run(self, request: Request, state: State, since: float) -> Result:
        # A cell is counted in the state of its table, unless a later one is wanted.
        stays = self._state == state or (request[0] == "cell" and not since)
        if self._computer is None or not stays:
            self._end()
            # Another process for another state: all that was made of the old one ends with it.
            try:
                self._computer, self._state = self.start(self.db), state
            except OSError as exc:
                raise Failure(f"no process can be started to compute: {exc}") from exc
        if self._closed:
            self._end()
            raise Failure("the explorer ends")
        assert self._state is not None
        made_in = self._state
        try:
            content = self._computer.ask(request)
        except Ended:
            self._end()
            raise
        return Result(content, made_in, time.time())

    def _end(self) -> None:
        if self._computer is not None:
            self._computer.close()
        self._computer = self._state = None


def about_s(request: Request, trials: int) -> int:
    """About how long a first answer takes, in s: to load pandas, to read the trials, to fit."""
    return round(12 + trials / 500 + sum(LONG_S.get(name, 1) for name in request[1:]))
