"""When a call is tried again: after what, for how long, and when to give up.

tenacity's loop carries this; what it is given are our wait, which no server can shorten, and our
deadline, from which the wait for a turn is left out: standing in the limiter's queue is no fault of
the provider.
"""

from __future__ import annotations

import asyncio
import random
from collections.abc import Awaitable, Callable, Iterator
from contextlib import contextmanager
from typing import NoReturn

from tenacity import AsyncRetrying, RetryCallState, retry_if_exception_type

from merge_runner.errors import MergeRunnerError

FIRST_BACKOFF_S, LONGEST_BACKOFF_S = 0.5, 60.0


class TryAgain(MergeRunnerError):
    """An attempt failed in a way that passes; ``delay_s`` is what the server asked for."""

    def __init__(self, message: str, delay_s: float | None = None) -> None:
        super().__init__(message)
        self.delay_s = delay_s


class RequestFailed(MergeRunnerError):
    """The provider rejects this one request; asking again would not help."""


class OutOfTime(MergeRunnerError):
    """A call's deadline would pass before the next attempt."""


def backoff_s(attempts: int) -> float:
    """The wait after so many failed attempts, without jitter."""
    return float(min(FIRST_BACKOFF_S * 2 ** min(attempts - 1, 10), LONGEST_BACKOFF_S))


def retries(
    deadline: Deadline, *, sleep: Callable[[float], Awaitable[None]] = asyncio.sleep
) -> AsyncRetrying:
    """Called with a coroutine function: makes attempts while it raises TryAgain, or OutOfTime."""
    return AsyncRetrying(
        retry=retry_if_exception_type(TryAgain),
        wait=_wait_s,
        stop=deadline.would_pass,
        before_sleep=deadline.count_wait,
        sleep=sleep,
        retry_error_callback=deadline.give_up,
    )


class Deadline:
    """How long a call may take: its attempts and the waits between them."""

    def __init__(self, seconds: float) -> None:
        self._seconds = seconds
        self._used_s = 0.0

    @contextmanager
    def attempt(self) -> Iterator[float]:
        """Within this time counts; yields the seconds that are left."""
        loop = asyncio.get_running_loop()
        began = loop.time()
        try:
            yield self._seconds - self._used_s
        finally:
            self._used_s += loop.time() - began

    def would_pass(self, state: RetryCallState) -> bool:
        """Tenacity's ``stop``: whether the deadline ends the next wait."""
        return self._used_s + state.upcoming_sleep >= self._seconds

    def count_wait(self, state: RetryCallState) -> None:
        """Tenacity's ``before_sleep``."""
        self._used_s += state.upcoming_sleep

    def give_up(self, state: RetryCallState) -> NoReturn:
        """Tenacity's ``retry_error_callback``: raises OutOfTime."""
        last = _failure(state)
        asked_s = last.delay_s
        if asked_s is None or asked_s < self._seconds:
            raise OutOfTime(f"no answer within {self._seconds:.0f} s") from last
        raise OutOfTime(
            f"the server asks to wait {asked_s:.0f} s, longer than a call's deadline of "
            f"{self._seconds:.0f} s: run the same command again after that"
        ) from last


def _wait_s(state: RetryCallState) -> float:
    """Tenacity's ``wait``: the backoff, or longer where the server asks for it.

    Its own waits cannot be joined by the longer of two, and 9.2 renames their parameters.
    """
    # Calls that failed together, as when a server restarts, do not return together.
    jitter_s = random.uniform(0, FIRST_BACKOFF_S)  # noqa: S311 # no secret
    backoff = min(backoff_s(state.attempt_number) + jitter_s, LONGEST_BACKOFF_S)
    return max(_failure(state).delay_s or 0.0, backoff)


def _failure(state: RetryCallState) -> TryAgain:
    """What the last attempt raised; tenacity asks only after what is tried again."""
    error = state.outcome.exception() if state.outcome else None
    assert isinstance(error, TryAgain)
    return error
