"""Waits before the next attempt: the server's delay, or exponential backoff."""

from __future__ import annotations

import random
import re
from contextlib import suppress
from datetime import UTC, datetime, timedelta
from email.utils import parsedate_to_datetime
from math import inf
from typing import TYPE_CHECKING

from merge_runner.errors import MergeRunnerError
from merge_runner.llm.formats.server_error import ServerError, known_delay_s
from merge_runner.llm.formats.wire import WireFormat

if TYPE_CHECKING:
    from tenacity import RetryCallState

FIRST_BACKOFF_S, LONGEST_BACKOFF_S = 0.5, 60.0
# In 2001: a smaller number is a duration, not a Unix time.
SMALLEST_UNIX_S = 1e9
_UNIT_S = {"ms": 0.001, "milli": 0.001, "s": 1.0, "m": 60.0, "h": 3600.0, "d": 86400.0}
# 1.574s and 6m0s, but also 5 minutes.
_PART = r"(\d+(?:\.\d+)?)\s*(ms|milli|[smhd])(?:ec|sec|econd|second|in|inute|r|our|ay)?s?(?![a-z])"
_IN_TEXT = re.compile(rf"(?:try again|retry) (?:in|after) ({_PART}(?:(?:,|\s|and)*{_PART})*)", re.I)
# Repeated headers are joined by commas, and a date contains a comma.
_LISTED = re.compile("[A-Z][a-z]{2}, [^,]+|[^,]+")


def server_delay_s(
    error: ServerError, wire: WireFormat, now: datetime | None = None
) -> float | None:
    """Return the delay in s that a failed reply asks for, None without a usable one.

    Sources in order: ``retry-after-ms``, ``retry-after`` (seconds or HTTP date), a member of the
    error, "try again in 1.574s" or "retry after 5 minutes" in the message, and for a 429
    ``x-ratelimit-reset``. Of several values of a header the longest counts.
    """
    in_text = _IN_TEXT.search(error.message)
    parts = re.findall(_PART, in_text[1], re.I) if in_text else []
    candidates = (
        _longest_s(error.headers.get("retry-after-ms", ""), now) / 1000,
        _longest_s(error.headers.get("retry-after", ""), now),
        wire.delay_s(error) or known_delay_s(error) or 0.0,
        sum(float(number) * _UNIT_S[unit.lower()] for number, unit in parts),
        _reset_s(error, now) if error.status == 429 else 0.0,
    )
    return next((delay for delay in candidates if 0 < delay < inf), None)


def _longest_s(header: str, now: datetime | None) -> float:
    """Return the longest usable delay among the values of a header, 0 if there is none."""
    delays = [0.0]
    for text in _LISTED.findall(header):
        with suppress(ValueError):
            delays.append(float(text))
            continue
        with suppress(ValueError, OverflowError):  # the latter: beyond the first or last date
            moment = parsedate_to_datetime(text)
            aware = moment if moment.tzinfo else moment.replace(tzinfo=UTC)
            delays.append((aware - (now or datetime.now(UTC))).total_seconds())
    return max(delay for delay in delays if 0 <= delay < inf)


def _reset_s(error: ServerError, now: datetime | None) -> float:
    """Return the time in s until a used-up limit is reset, 0 if it is unknown.

    The header is a number of seconds, or a Unix time in s or ms, as at OpenRouter.
    """
    reset = error.headers.get("x-ratelimit-reset", "")
    if error.headers.get("x-ratelimit-remaining", "0") != "0" or not reset.isdecimal():
        return 0.0
    number = float(reset)
    for scale in (1000, 1):
        if number / scale > SMALLEST_UNIX_S:
            return number / scale - (now or datetime.now(UTC)).timestamp()
    return number


def utc_after(seconds: float) -> str:
    """Return the moment after a delay in s, to the minute."""
    try:
        return f"{datetime.now(UTC) + timedelta(seconds=seconds):%Y-%m-%d %H:%M} UTC"
    except OverflowError:
        return "a moment after the year 9999"


class TryAgain(MergeRunnerError):
    """A transient failure of an attempt; ``delay_s`` is the delay that the server asks for."""

    def __init__(self, message: str, delay_s: float | None = None) -> None:
        super().__init__(message)
        self.delay_s = delay_s


def backoff_s(attempts: int) -> float:
    """Return the wait in s after a number of failed attempts, without jitter."""
    # Bounded: after a thousand attempts the power would overflow.
    return float(min(FIRST_BACKOFF_S * 2 ** min(attempts - 1, 10), LONGEST_BACKOFF_S))


def next_wait_s(state: RetryCallState) -> float:
    """Return the wait in s after a failed attempt: the backoff, or the server's longer one."""
    error = state.outcome.exception() if state.outcome else None
    assert isinstance(error, TryAgain)
    # Calls that failed together, as when a server restarts, do not return together.
    jitter_s = random.uniform(0, FIRST_BACKOFF_S)  # noqa: S311 # no secret
    return max(
        error.delay_s or 0, min(backoff_s(state.attempt_number) + jitter_s, LONGEST_BACKOFF_S)
    )
