"""How long a server asks to wait, in the many places where servers say so."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable
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
_IN_TEXT = re.compile(rf"(?:try again|retry) (?:in|after) ({_PART}(?:(?:,|\s|and)*{_PART})*)", re.I)
# A header that is sent several times has all its values in one, and a date has a comma of its own.
_LISTED = re.compile(r"(?:(?:mon|tue|wed|thu|fri|sat|sun)[a-z]*,)?[^,]+", re.I)
# A server that asks for longer means for ever, and dates end somewhere.
MOST_S = 366 * 86400.0


def server_delay_s(
    error: ServerError, formats: Iterable[WireFormat], now: datetime | None = None
) -> float | None:
    """Return the delay in s that a failed reply asks for, None if it says nothing usable.

    Sources in order: ``retry-after-ms``, ``retry-after`` (seconds or HTTP date), a member of the
    error that one of the ``formats`` knows, and "try again in 1.574s" or "retry after 5 minutes" in
    the message. Of several values of a header the longest counts, and of a delay a year at most.
    """
    in_text = _IN_TEXT.search(error.message)
    candidates = (
        _longest(error.headers.get("retry-after-ms", ""), lambda text: float(text) / 1000),
        _longest(error.headers.get("retry-after", ""), lambda text: _retry_after_s(text, now)),
        *(wire.delay_s(error) for wire in formats),
        _duration_s(in_text[1]) if in_text else None,
    )
    return next((min(delay, MOST_S) for delay in candidates if _is_usable(delay)), None)


def _is_usable(delay_s: float | None) -> TypeGuard[float]:
    return delay_s is not None and 0 < delay_s < float("inf")


def _longest(header: str, read: Callable[[str], float]) -> float | None:
    delays = []
    for text in _LISTED.findall(header):
        try:
            delays.append(read(text))
        except (ValueError, OverflowError):  # the latter: a zone beyond the first or last date
            continue
    return max(filter(_is_usable, delays), default=None)


def _duration_s(text: str) -> float:
    """Return the seconds of ``6m0s``, ``1h30m``, ``120ms`` or ``5 minutes``."""
    parts = [(number, unit.lower()) for number, unit in _PARTS.findall(text)]
    return sum(
        float(number) * _UNIT_S["ms" if unit.startswith(("ms", "milli")) else unit[0]]
        for number, unit in parts
    )


def _retry_after_s(text: str, now: datetime | None) -> float:
    try:
        return float(text)
    except ValueError:
        moment = parsedate_to_datetime(text)
    aware = moment if moment.tzinfo else moment.replace(tzinfo=UTC)
    return (aware - (now or datetime.now(UTC))).total_seconds()
