"""When a call is tried again: after what, for how long, and when to give up.

The loop is tenacity's. Ours are the wait, which no server can shorten, and the deadline, which does
not count the wait for a turn: standing in the limiter's queue is no fault of the provider.
"""

from __future__ import annotations

import asyncio
import random
from collections.abc import Awaitable, Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, NoReturn

from merge_runner.errors import MergeRunnerError

if TYPE_CHECKING:
    from tenacity import AsyncRetrying, RetryCallState

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
    # The exponent is bounded: after a thousand attempts the power would fit in no float.
    return float(min(FIRST_BACKOFF_S * 2 ** min(attempts - 1, 10), LONGEST_BACKOFF_S))


def retries(
    deadline: Deadline, *, sleep: Callable[[float], Awaitable[None]] = asyncio.sleep
) -> AsyncRetrying:
    """A loop of attempts, each a context, that goes on while they raise TryAgain.

    Raises OutOfTime when the deadline would pass before the next one.
    """
    from tenacity import AsyncRetrying, retry_if_exception_type  # a replay needs none of it

    # Looped over, since to wrap a function for each call would take twice the processor time.
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
        """The time within this counts; yields the seconds that are left for it."""
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
        # Where the server's own wish made the wait too long, that is what to tell.
        asked_s = last.delay_s
        if asked_s is None or asked_s < self._seconds:
            raise OutOfTime(f"no answer within {self._seconds:.0f} s") from last
        raise OutOfTime(
            f"the server asks to wait {asked_s:.0f} s, longer than a call's deadline of "
            f"{self._seconds:.0f} s: run the same command again after that"
        ) from last


def _wait_s(state: RetryCallState) -> float:
    """Tenacity's ``wait``: the backoff, or longer where the server asks for it."""
    # Not made of tenacity's waits: those can be added, but not joined by the longer of two.
    # The jitter lets calls that failed together, as when a server restarts, not return together.
    jitter_s = random.uniform(0, FIRST_BACKOFF_S)  # noqa: S311 # no secret
    backoff = min(backoff_s(state.attempt_number) + jitter_s, LONGEST_BACKOFF_S)
    return max(_failure(state).delay_s or 0.0, backoff)


def _failure(state: RetryCallState) -> TryAgain:
    """What the last attempt raised; tenacity calls these hooks after a TryAgain alone."""
    error = state.outcome.exception() if state.outcome else None
    assert isinstance(error, TryAgain)
    return error
