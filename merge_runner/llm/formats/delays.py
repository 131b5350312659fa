"""How long a server asks to wait, in the many places where servers say so."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping
from datetime import UTC, datetime
from email.utils import parsedate_to_datetime
from typing import TypeGuard

from merge_runner.llm.formats.base import ServerError, WireFormat

_UNIT_S = {"ms": 0.001, "s": 1, "m": 60, "h": 3600, "d": 86400}
# 1.574s and 5m, but also 5 minutes.
_PART = (
    r"(\d+(?:\.\d+)?)\s*"
    r"(ms|milliseconds?|s|secs?|seconds?|m|mins?|minutes?|h|hrs?|hours?|d|days?)(?![a-z])"
)
_PARTS = re.compile(_PART, re.I)
_DURATION = re.compile(rf"{_PART}(?:(?:,|\s|and)*{_PART})*", re.I)
# A header that is sent several times has all its values in one, and a date has a comma of its own.
_LISTED = re.compile(r"(?:(?:mon|tue|wed|thu|fri|sat|sun)[a-z]*,)?[^,]+", re.I)
# A server that asks for longer means for ever, and dates end somewhere.
MOST_S = 366 * 86400.0
_IN_TEXT = re.compile(rf"(?:try again|retry) (?:in|after) ({_DURATION.pattern})", re.I)
# Azure counts on below zero.
NONE_REMAINS = re.compile(r"0|-\d+")


def server_delay_s(
    error: ServerError, formats: Iterable[WireFormat], now: datetime | None = None
) -> float | None:
    """The delay in s that a failed reply asks for, None where it says nothing usable.

    Sources in order: ``retry-after-ms``, ``retry-after`` (seconds or HTTP date), a member of the
    error that one of the ``formats`` knows, "try again in 1.574s" or "retry after 5 minutes" in
    the message, then the reset times of exhausted limits that one of them knows. Of several values
    of a header the longest counts, and of a delay a year at most.
    """
    at = now or datetime.now(UTC)
    wires = tuple(formats)
    candidates = (
        _longest(error.headers, "retry-after-ms", lambda text: _scaled(text, 1000)),
        _longest(error.headers, "retry-after", lambda text: _retry_after(text, at)),
        *(wire.delay_s(error) for wire in wires),
        _in_text(error.message),
        *(wire.reset_s(error.headers, at) for wire in wires),
    )
    return next((min(d, MOST_S) for d in candidates if _usable(d)), None)


def _usable(delay_s: float | None) -> TypeGuard[float]:
    return delay_s is not None and 0 < delay_s < float("inf")


def _longest(
    headers: Mapping[str, str], name: str, read: Callable[[str], float | None]
) -> float | None:
    values = _LISTED.findall(headers.get(name, ""))
    return max(filter(_usable, map(read, values)), default=None)


def duration_s(text: str) -> float | None:
    """Seconds of ``6m0s``, ``1h30m``, ``120ms`` or ``5 minutes``; Azure sends a bare ``64``."""
    if not _DURATION.fullmatch(text.strip()):
        return _scaled(text, 1)
    return sum(float(number) * _UNIT_S[_unit(word)] for number, word in _PARTS.findall(text))


def _unit(word: str) -> str:
    return "ms" if word.lower() in ("ms", "millisecond", "milliseconds") else word[0].lower()


def _scaled(text: str | None, per_second: float) -> float | None:
    try:
        return float(text) / per_second if text else None
    except ValueError:
        return None


def _retry_after(text: str, now: datetime) -> float | None:
    seconds = _scaled(text, 1)
    if seconds is not None:
        return seconds
    try:
        return until_s(parsedate_to_datetime(text), now)
    except (ValueError, OverflowError):  # the latter: a zone beyond the first or last date
        return None


def _in_text(message: str) -> float | None:
    match = _IN_TEXT.search(message)
    return duration_s(match.group(1)) if match else None


def until_s(moment: datetime, now: datetime) -> float:
    """Seconds until a moment, which is UTC where it names no zone."""
    aware = moment if moment.tzinfo else moment.replace(tzinfo=UTC)
    return (aware - now).total_seconds()
