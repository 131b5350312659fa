"""What a raw HTTP reply means: an answer, something to try again, or a reason to stop.

``judge`` says what a reply is by itself; what follows for its call and its run, the client decides.
"""

from __future__ import annotations

import json
import random
import re
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from email.utils import parsedate_to_datetime
from functools import cached_property
from math import inf
from typing import TYPE_CHECKING, Literal
from urllib.parse import urlsplit

from merge_runner.config import PROVIDERS, ModelEntry
from merge_runner.errors import MergeRunnerError
from merge_runner.llm.formats import (
    BROKEN_OFF,
    Reading,
    ServerError,
    WireFormat,
    as_dict,
    at,
    is_error,
    known_delay_s,
    known_meaning,
    read_error,
    read_reply,
)

if TYPE_CHECKING:
    from tenacity import RetryCallState

Action = Literal["accept", "retry", "fail", "quota", "refused"]
REGISTRY = "experiments/models.toml"
FIRST_BACKOFF_S, LONGEST_BACKOFF_S = 0.5, 60.0
# The statuses of a refusal that names the request.
REQUEST_ITSELF = (200, 400, 413, 422, 429)
# Azure charges for a prompt that it has looked at, also where it then refuses it.
CHARGED_ERRORS = frozenset({"content_filter", "context_length_exceeded"})
TOO_LATE = frozenset({408, 499, 504, 524})

# What a status means unless a format knows better; any other one means a bad request.
STATUSES = {
    401: "not_allowed",
    402: "quota_exhausted",
    403: "not_allowed",
    404: "unknown_model",
    408: "request_timeout",
    409: "conflict",
    429: "rate_limited",
    503: "overloaded",
    504: "server_timeout",
    524: "server_timeout",
    529: "overloaded",
    **dict.fromkeys((500, 502, 520, 521, 522, 523), "server_error"),
}
# What to do about it; anything else fails its call.
ACTIONS: dict[str, Action] = {
    "refusal": "accept",
    "quota_exhausted": "quota",
    "not_allowed": "refused",
    "unknown_model": "refused",
    **dict.fromkeys(("rate_limited", "request_timeout", "conflict"), "retry"),
    **dict.fromkeys(("server_error", "overloaded", "server_timeout"), "retry"),
}

_UNIT_S = {"ms": 0.001, "milli": 0.001, "s": 1.0, "m": 60.0, "h": 3600.0, "d": 86400.0}
# 1.574s and 6m0s, but also 5 minutes.
_PART = r"(\d+(?:\.\d+)?)\s*(ms|milli|[smhd])(?:ec|sec|econd|second|in|inute|r|our|ay)?s?(?![a-z])"
_IN_TEXT = re.compile(rf"(?:try again|retry) (?:in|after) ({_PART}(?:(?:,|\s|and)*{_PART})*)", re.I)
# A header that is sent several times has all its values in one, and a date has a comma of its own.
_LISTED = re.compile("[A-Z][a-z]{2}, [^,]+|[^,]+")


@dataclass(frozen=True)
class RawReply:
    """A reply as received: ``headers`` have lower-case names, ``body`` is the text."""

    status: int
    headers: Mapping[str, str]
    body: str

    @cached_property
    def payload(self) -> object:
        """The body as JSON, read once; None where it is none.

        An error is taken out of the list into which Gemini may wrap it.
        """
        try:
            payload: object = json.loads(self.body)
        except (ValueError, RecursionError):  # the latter: nested beyond any honest reply
            return None
        if self.status != 200 and isinstance(payload, list):
            return payload[0] if payload else None
        return payload

    @cached_property
    def error(self) -> ServerError:
        """The body as an error."""
        return read_error(self.status, self.headers, self.body, self.payload)

    @property
    def is_web_page(self) -> bool:
        """Whether a web site answers: no service of any format sends this as an answer."""
        return self.body.lstrip("\ufeff \t\r\n")[:9].lower().startswith(("<!doctype", "<html"))


class TransportFailure(MergeRunnerError):
    """An attempt brought no reply; ``outcome`` names the failure in the calls table.

    ``sent`` is False where the request was certainly never sent, so that nobody can charge for it.
    ``action`` is that of an AttemptOutcome.
    """

    def __init__(
        self, outcome: str, message: str, *, sent: bool = True, action: Action = "retry"
    ) -> None:
        super().__init__(message)
        self.outcome = outcome
        self.sent = sent
        self.action = action


@dataclass(frozen=True, slots=True)
class AttemptOutcome:
    """What an attempt brought, and what to do about it.

    ``accept`` it as the answer, ``retry`` after ``delay_s`` (all calls of the key wait where
    ``pause``), ``fail`` this call, or stop the sweep because the ``quota`` is exhausted or the
    endpoint ``refused`` the key or the model. ``name`` is its outcome in the calls table.
    Without a ``raw`` reply the attempt may have been ``charged`` all the same.
    """

    action: Action
    name: str
    message: str | None = None
    reading: Reading = Reading("error")  # noqa: RUF009 # frozen
    delay_s: float | None = None
    pause: bool = False
    raw: RawReply | None = None
    charged: bool = True


def may_be_charged(raw: RawReply, endpoint: str) -> bool:
    """Return whether a reply without usage may have been billed.

    A refusal before any work is not, nor an error with the members that a provider documents for
    its own, where ``endpoint`` says that its own host answered. That of a gateway, or one for want
    of time, may follow an answer that was made.
    """
    own = PROVIDERS.get(endpoint)
    if raw.status < 300 or raw.status in TOO_LATE or '"usage' in raw.body:
        return True
    if raw.status < 500:
        return own is None and bool(raw.error.names & CHARGED_ERRORS)
    members = own.error_members if own else frozenset()
    return not members or not members <= as_dict(as_dict(raw.payload).get("error")).keys()


def judge(raw: RawReply, wire: WireFormat) -> AttemptOutcome:
    """Classify a reply by the rules of docs/reference/providers.md."""
    if raw.status == 200 and not isinstance(raw.payload, dict):
        return AttemptOutcome("retry", "bad_body", "the body is not a JSON object", raw=raw)
    body = as_dict(raw.payload)
    reading = read_reply(wire, body)
    if raw.status != 200:
        reading = Reading("error", usage=reading.usage)  # which is billed
        return replace(judge_error(raw.error, wire), reading=reading, raw=raw)
    told = is_error(body.get("error")) or is_error(at(body, "choices.0.error"))
    if reading.outcome == "error" and not told and reading.finish_reason in BROKEN_OFF:
        why = f"the server broke its answer off (finish reason {reading.finish_reason})"
        return AttemptOutcome("retry", "server_error", why, reading, raw=raw)
    if reading.outcome == "error":
        error = replace(raw.error, status=status_within(raw.error))
        return replace(judge_error(error, wire), reading=reading, raw=raw)
    if reading.outcome == "empty" and not any(body.get(name) for name in wire.members):
        why = "the body has nothing of an answer"
        return AttemptOutcome("retry", "bad_body", why, reading, raw=raw)
    return AttemptOutcome("accept", reading.outcome, reading=reading, raw=raw)


def status_within(error: ServerError) -> int:
    """Return the status that an error within a 200 stands for: 400 or 500 if nobody knows it."""
    if "rate_limit_exceeded" in error.names:
        return 429
    if error.names == {"server_error"}:
        return 500
    numbers = [int(name) for name in error.names if re.fullmatch("[45][0-9][0-9]", name)]
    return numbers[0] if numbers else 400 if error.names else 500


def judge_error(error: ServerError, wire: WireFormat) -> AttemptOutcome:
    """Classify an error, whatever was asked for."""
    name = wire.meaning(error) or known_meaning(error) or STATUSES.get(error.status, "bad_request")
    action = ACTIONS.get(name, "fail")
    return AttemptOutcome(
        action,
        name,
        f"HTTP {error.status}: {error.message}",
        delay_s=server_delay_s(error, wire) if action == "retry" else None,
        pause=name == "rate_limited",
    )


def server_delay_s(
    error: ServerError, wire: WireFormat, now: datetime | None = None
) -> float | None:
    """Return the delay in s that a failed reply asks for, None if it says nothing usable.

    Sources in order: ``retry-after-ms``, ``retry-after`` (seconds or HTTP date), a member of the
    error, and "try again in 1.574s" or "retry after 5 minutes" in the message. Of several values of
    a header the longest counts.
    """
    told = _IN_TEXT.search(error.message)
    parts = re.findall(_PART, told[1], re.I) if told else []
    candidates = (
        _longest_s(error.headers.get("retry-after-ms", ""), now) / 1000,
        _longest_s(error.headers.get("retry-after", ""), now),
        wire.delay_s(error) or known_delay_s(error) or 0.0,
        sum(float(number) * _UNIT_S[unit.lower()] for number, unit in parts),
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


class TryAgain(MergeRunnerError):
    """An attempt failed in a way that passes; ``delay_s`` is what the server asked for."""

    def __init__(self, message: str, delay_s: float | None = None) -> None:
        super().__init__(message)
        self.delay_s = delay_s


def backoff_s(attempts: int) -> float:
    """Return the wait in s after so many failed attempts, without jitter."""
    # The exponent is bounded: after a thousand attempts the power would fit in no float.
    return float(min(FIRST_BACKOFF_S * 2 ** min(attempts - 1, 10), LONGEST_BACKOFF_S))


def next_wait_s(state: RetryCallState) -> float:
    """Return the wait in s after a failed attempt: the backoff, or the server's longer one."""
    error = state.outcome.exception() if state.outcome else None
    assert isinstance(error, TryAgain)
    # The jitter lets calls that failed together, as when a server restarts, not return together.
    jitter_s = random.uniform(0, FIRST_BACKOFF_S)  # noqa: S311 # no secret
    return max(
        error.delay_s or 0, min(backoff_s(state.attempt_number) + jitter_s, LONGEST_BACKOFF_S)
    )


def why_refused(name: str, entry: ModelEntry, outcome: AttemptOutcome) -> str | None:
    """Return why all calls of a run would fail, and what to set; None: they might not."""
    raw, place = outcome.raw, f"[{name}] in {REGISTRY}"
    base_url = set_base_url(name, entry)
    key = " or ".join(entry.key_envs) or f"`key_env` of {place}"
    if outcome.action == "refused":
        why = {
            "bad_certificate": "the endpoint's certificate cannot be trusted, and nothing was "
            "sent; check the base URL, or set SSL_CERT_FILE to the certificates of whoever signed "
            "it",
            "not_allowed": f"the endpoint does not accept the key; set {key} to a valid one",
            "unknown_model": f"the endpoint has no model {entry.id!r}; see `merge-runner models`, "
            f"or {base_url}",
        }[outcome.name]
    elif raw is None or outcome.name == "bad_prompt":
        return None
    elif outcome.action == "fail" and raw.status in REQUEST_ITSELF:
        why = f"the request is refused: look at {place}"
    elif (
        outcome.action == "fail"
        or (raw.is_web_page and raw.status == 200)
        or (outcome.name == "bad_body" and isinstance(raw.payload, dict))
    ):
        why = f"what answers there does not speak {entry.format}: {base_url}"
    else:
        return None
    return f"{why} ({outcome.message})"


def if_nobody(name: str, entry: ModelEntry) -> str:
    """Return what a user can do if no server answers."""
    what = PROVIDERS[entry.provider].if_nobody
    return f"{what}, or {set_base_url(name, entry)}; then run the same command again"


def set_base_url(name: str, entry: ModelEntry) -> str:
    """Return how a user corrects the base URL of an entry."""
    provider = PROVIDERS[entry.provider]
    if entry.base_url is not None or provider.base_url_env is None:
        return f"correct `base_url` of [{name}] in {REGISTRY}"
    path = urlsplit(provider.base_url).path
    ending = f" (with {path} at its end)" if path else ""
    return f"set {provider.base_url_env} to the base URL of the service{ending}, or unset it"
