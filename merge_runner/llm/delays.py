"""How long a server asks to wait, in the many places where servers say so."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from datetime import UTC, datetime
from email.utils import parsedate_to_datetime
from typing import Any

from merge_runner.llm.formats.base import as_dict, as_list, as_text

_GO_DURATION = re.compile(r"(?:(\d+)h)?(?:(\d+)m)?(?:(\d+(?:\.\d+)?)s)?(?:(\d+(?:\.\d+)?)ms)?")
_PROTOBUF_DURATION = re.compile(r"(\d+(?:\.\d+)?)s")
_IN_TEXT = re.compile(r"(?:try again|retry) in ([\d.hms]+)", re.I)


def server_delay_s(
    headers: Mapping[str, str], payload: object, now: Callable[[], datetime] | None = None
) -> float | None:
    """The delay in s that a failed reply asks for, None where it says nothing usable.

    Sources in order: ``retry-after-ms``, ``retry-after`` (seconds or HTTP date), Gemini's
    RetryInfo, "try again in 1.574s" in the message, then the reset times of exhausted limits.
    ``headers`` have lower-case names; ``now`` gives the UTC time.
    """
    clock = now or (lambda: datetime.now(UTC))
    error = as_dict(as_dict(payload).get("error"))
    candidates = (
        _scaled(headers.get("retry-after-ms"), 1000),
        _retry_after(headers.get("retry-after"), clock),
        _retry_info(error),
        _in_text(as_text(error.get("message")) or ""),
        _openai_resets(headers),
        _anthropic_resets(headers, clock),
    )
    return next((d for d in candidates if d is not None and 0 < d < float("inf")), None)


def go_duration_s(text: str) -> float | None:
    """Seconds of a Go-style duration like ``6m0s``, ``1h30m`` or ``120ms``; Azure sends ``64``."""
    match = _GO_DURATION.fullmatch(text.strip())
    if not match or not any(match.groups()):
        return _scaled(text, 1)
    hours, minutes, seconds, milliseconds = (float(group or 0) for group in match.groups())
    return hours * 3600 + minutes * 60 + seconds + milliseconds / 1000


def _scaled(text: str | None, per_second: float) -> float | None:
    try:
        return float(text) / per_second if text else None
    except ValueError:
        return None


def _retry_after(text: str | None, clock: Callable[[], datetime]) -> float | None:
    seconds = _scaled(text, 1)
    if seconds is not None or not text:
        return seconds
    try:
        return _until(parsedate_to_datetime(text), clock)
    except ValueError:
        return None


def _retry_info(error: dict[str, Any]) -> float | None:
    for detail in as_list(error.get("details")):
        match = _PROTOBUF_DURATION.fullmatch(as_text(as_dict(detail).get("retryDelay")) or "")
        if match:
            return float(match.group(1))
    return None


def _in_text(message: str) -> float | None:
    match = _IN_TEXT.search(message)
    return go_duration_s(match.group(1).rstrip(".")) if match else None


def _openai_resets(headers: Mapping[str, str]) -> float | None:
    """The longest reset among the limits of which nothing remains."""
    delays = [
        go_duration_s(headers.get(f"x-ratelimit-reset-{kind}", ""))
        for kind in ("requests", "tokens")
        if headers.get(f"x-ratelimit-remaining-{kind}") == "0"
    ]
    return max((delay for delay in delays if delay is not None), default=None)


def _anthropic_resets(headers: Mapping[str, str], clock: Callable[[], datetime]) -> float | None:
    delays = []
    for kind in ("requests", "tokens", "input-tokens", "output-tokens"):
        if headers.get(f"anthropic-ratelimit-{kind}-remaining") != "0":
            continue
        try:
            reset = datetime.fromisoformat(headers.get(f"anthropic-ratelimit-{kind}-reset", ""))
        except ValueError:
            continue
        delays.append(_until(reset, clock))
    return max(delays, default=None)


def _until(moment: datetime, clock: Callable[[], datetime]) -> float:
    aware = moment if moment.tzinfo else moment.replace(tzinfo=UTC)
    return (aware - clock()).total_seconds()
