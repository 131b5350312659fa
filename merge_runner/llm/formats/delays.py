"""How long a server asks to wait, in the many places where servers say so."""

from __future__ import annotations

import re
from collections.abc import Iterable
from contextlib import suppress
from datetime import UTC, datetime
from email.utils import parsedate_to_datetime
from math import inf

from merge_runner.llm.formats.base import ServerError, WireFormat

# The seconds of a unit by its first letter; milliseconds apart.
_UNIT_S = {"s": 1, "m": 60, "h": 3600, "d": 86400}
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
        _longest_s(error.headers.get("retry-after-ms", ""), 0.001, now),
        _longest_s(error.headers.get("retry-after", ""), 1, now),
        *(wire.delay_s(error) or 0.0 for wire in formats),
        _duration_s(in_text[1]) if in_text else 0.0,
    )
    return next((min(delay, MOST_S) for delay in candidates if 0 < delay < inf), None)


def _longest_s(header: str, unit_s: float, now: datetime | None) -> float:
    """Return the longest usable delay among the values of a header, 0 if there is none."""
    delays = [0.0]
    for text in _LISTED.findall(header):
        with suppress(ValueError):
            delays.append(float(text) * unit_s)
            continue
        with suppress(ValueError, OverflowError):  # the latter: beyond the first or last date
            moment = parsedate_to_datetime(text)
            aware = moment if moment.tzinfo else moment.replace(tzinfo=UTC)
            delays.append((aware - (now or datetime.now(UTC))).total_seconds())
    return max(delay for delay in delays if 0 <= delay < inf)


def _duration_s(text: str) -> float:
    """Return the seconds of ``6m0s``, ``1h30m``, ``120ms`` or ``5 minutes``."""
    parts = [(float(number), unit.lower()) for number, unit in _PARTS.findall(text)]
    return sum(
        number * (0.001 if unit.startswith(("ms", "milli")) else _UNIT_S[unit[0]])
        for number, unit in parts
    )
