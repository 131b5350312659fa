"""When a call is tried again: after what, for how long, and when to give up."""

from __future__ import annotations

import asyncio
import random
from collections.abc import Awaitable, Callable
from typing import TypeVar

from tenacity import AsyncRetrying, RetryCallState, RetryError, retry_if_exception_type

from merge_runner.errors import MergeRunnerError

AnswerT = TypeVar("AnswerT")
TurnT = TypeVar("TurnT")
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


async def call_with_retries(
    take_turn: Callable[[], Awaitable[TurnT]],
    attempt: Callable[[TurnT, int, float], Awaitable[AnswerT]],
    *,
    deadline_s: float,
    sleep: Callable[[float], Awaitable[None]] = asyncio.sleep,
) -> AnswerT:
    """Take a turn and make an attempt, again while it raises TryAgain; raises OutOfTime.

    ``attempt`` gets the turn, its number from 1 and the seconds left. The deadline counts the
    attempts and the waits between them, but not the wait for a turn: standing in the limiter's
    queue is no fault of the provider.
    """
    loop = asyncio.get_running_loop()
    used_s = 0.0

    def wait(state: RetryCallState) -> float:
        error = state.outcome.exception() if state.outcome else None
        asked = error.delay_s if isinstance(error, TryAgain) else None
        jitter_s = random.uniform(0, FIRST_BACKOFF_S)  # noqa: S311 # no secret
        backoff = min(backoff_s(state.attempt_number) + jitter_s, LONGEST_BACKOFF_S)
        return max(asked or 0.0, backoff)

    def stop(state: RetryCallState) -> bool:
        return used_s + state.upcoming_sleep >= deadline_s

    async def counted_sleep(seconds: float) -> None:
        nonlocal used_s
        used_s += seconds
        await sleep(seconds)

    try:
        async for state in AsyncRetrying(
            retry=retry_if_exception_type(TryAgain), wait=wait, stop=stop, sleep=counted_sleep
        ):
            with state:
                turn = await take_turn()
                started = loop.time()
                try:
                    number = state.retry_state.attempt_number
                    return await attempt(turn, number, deadline_s - used_s)
                finally:
                    used_s += loop.time() - started
    except RetryError as exc:
        last = exc.last_attempt.exception()
        raise OutOfTime(_why_given_up(last, deadline_s)) from last
    raise AssertionError("unreachable: the loop returns or raises")


def _why_given_up(last: BaseException | None, deadline_s: float) -> str:
    asked_s = last.delay_s if isinstance(last, TryAgain) else None
    if asked_s is None or asked_s < deadline_s:
        return f"no answer within {deadline_s:.0f} s"
    return (
        f"the server asks to wait {asked_s:.0f} s, longer than a call's deadline of "
        f"{deadline_s:.0f} s: run the same command again after that"
    )
