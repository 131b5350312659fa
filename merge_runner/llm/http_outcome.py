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
from datetime import UTC, datetime, timedelta
from email.utils import parsedate_to_datetime
from functools import cached_property
from math import inf
from typing import TYPE_CHECKING, Literal
from urllib.parse import urlsplit

from merge_runner.errors import MergeRunnerError
from merge_runner.llm.formats import (
    BROKEN_OFF,
    Reading,
    ServerError,
    WireFormat,
    as_dict,
    as_text,
    at,
    is_error,
    is_per_day,
    known_delay_s,
    known_meaning,
    read_error,
    read_reply,
)
from merge_runner.providers import PROVIDERS, ModelEntry

if TYPE_CHECKING:
    from tenacity import RetryCallState

Action = Literal["accept", "retry", "fail", "quota", "refused"]
EXCERPT = 200
FIRST_BACKOFF_S, LONGEST_BACKOFF_S = 0.5, 60.0
# In 2001: a smaller number of s is no moment.
SMALLEST_UNIX_S = 1e9
# The statuses of a refusal that names the request.
REQUEST_ITSELF = (200, 400, 413, 422, 429)
# Azure charges for a prompt that it has looked at, also where it then refuses it.
CHARGED_ERRORS = frozenset({"content_filter", "context_length_exceeded"})
TOO_LATE = frozenset({408, 499, 504, 524})

# What a status means unless a format knows better; any other 5xx passes, and all else means a bad
# request.
STATUSES = {
    401: "not_allowed",
    402: "quota_exhausted",
    403: "not_allowed",
    404: "unknown_model",
    407: "proxy_refused",
    408: "request_timeout",
    409: "conflict",
    429: "rate_limited",
    499: "server_timeout",  # Gemini's CANCELLED
    503: "overloaded",
    504: "server_timeout",
    524: "server_timeout",
    529: "overloaded",
    # Not implemented, another HTTP version, a network that wants a login.
    **dict.fromkeys((501, 505, 511), "bad_request"),
}
# The status that a named error within a 200 stands for, where it has no number; the first counts.
WITHIN = {
    **dict.fromkeys(("rate_limit_exceeded", "rate_limit_error", "base_resp 1002"), 429),
    "RESOURCE_EXHAUSTED": 429,
    "invalid_prompt": 400,
    "base_resp 1008": 402,
    **dict.fromkeys(("base_resp 1004", "base_resp 2049"), 401),
    **dict.fromkeys(("overloaded_error", "server_is_overloaded"), 529),
    **dict.fromkeys(("service_unavailable_error", "UNAVAILABLE"), 503),
    **dict.fromkeys(("timeout_error", "DEADLINE_EXCEEDED", "base_resp 1001"), 504),
    **dict.fromkeys(("server_error", "api_error", "internal_server_error", "INTERNAL"), 500),
    **dict.fromkeys(("base_resp 1000", "base_resp 1013"), 500),
}
# What to do about it; anything else fails its call.
ACTIONS: dict[str, Action] = {
    "refusal": "accept",
    "quota_exhausted": "quota",
    "not_allowed": "refused",
    "unknown_model": "refused",
    "proxy_refused": "refused",
    **dict.fromkeys(("rate_limited", "request_timeout", "conflict"), "retry"),
    **dict.fromkeys(("server_error", "overloaded", "server_timeout"), "retry"),
}

# Why no call of a run would be answered, and what a user can do.
REASONS = {
    "bad_certificate": "the endpoint's certificate cannot be trusted, and nothing was sent; check "
    "the base URL, or set SSL_CERT_FILE to the certificates of whoever signed it",
    "not_allowed": "the endpoint does not accept the key; set {key} to a valid one",
    "unknown_model": "the endpoint has no model {id!r}; see `merge-runner models`, or {base_url}",
    "path_twice": "the base URL must not end with what the path begins with (such as /v1), or it "
    "stands there twice: {base_url}",
    "proxy_refused": "the proxy (HTTPS_PROXY, HTTP_PROXY or ALL_PROXY) lets nothing through, and "
    "nothing was sent: give its URL a user name and a password if it asks for them (407), have it "
    "allow the host, or name the host in NO_PROXY",
    "request": "the request is refused: look at {place}",
    "other_format": "what answers there does not speak {format}: {base_url}",
    "other_error": "the endpoint sends an error in the place of an answer: {base_url}",
    "stream": "the endpoint sends a stream of events (SSE), though none is asked for: switch "
    "streaming off at the server or at the gateway before it, take `stream` out of `parameters` of "
    "{place}, or {base_url}",
    "page": "what answers there is a web page and does not speak {format}: {base_url}",
    "packed": "the body has a Content-Encoding ({encoding}) that cannot be read: have the server, "
    "or the gateway before it, send it plain or as gzip",
    "unreadable_reply": "what answers there cannot be read: have the server, or the gateway before "
    "it, send headers of at most 64 KiB and a body that is plain or gzip",
    "reasoning_alone": "the whole answer lies in `reasoning_content`, and the content is empty: "
    "start the server without its reasoning parser (vLLM, SGLang: leave --reasoning-parser out; "
    "llama.cpp: --reasoning-format none), or let the model think, as `chat_template_kwargs = "
    "{{ enable_thinking = true }}` among `parameters` of {place} does",
}
# Those that a passing fault may look like: several in a row tell.
UNSURE = frozenset({"other_error", "text", "unreadable_reply", "proxy_refused"})
# A part of a path that follows itself, as in /v1/v1/messages.
_TWICE = re.compile(r"(/\w.*)\1(/|$)")
# After comments and other fields, since a plain text may begin with "id:", too.
_EVENTS = re.compile(r"\s*(?:(?:id|retry)?:[^\n]*\n\s*)*(?:data|event):", re.ASCII)

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

    @property
    def kind(self) -> str:
        """The kind of a body that is no answer, by the names of REASONS, or ``text``."""
        if self.payload is not None:
            return "other_format"
        if self._is("content-type", "text/event-stream") or _EVENTS.match(self.body):
            return "stream"
        if self.is_web_page:
            return "page"
        is_packed = "\ufffd" in self.body and not self._is("content-encoding", "identity")
        return "packed" if is_packed and self.headers.get("content-encoding") else "text"

    @property
    def excerpt(self) -> str:
        """The content type and the beginning of the body, in one line."""
        words = " ".join(self.body[:EXCERPT].split()) or "an empty body"
        return f"{self.headers.get('content-type', 'no content type')}: {words}"

    def _is(self, header: str, value: str) -> bool:
        return self.headers.get(header, "").lower().strip().startswith(value)


class TransportFailure(MergeRunnerError):
    """An attempt brought no reply; ``outcome`` names the failure in the calls table.

    ``sent`` is False where the request was certainly never sent, so that nobody can charge for it.
    ``action`` and ``reason`` are those of an AttemptOutcome.
    """

    def __init__(
        self,
        outcome: str,
        message: str,
        *,
        sent: bool = True,
        action: Action = "retry",
        reason: str | None = None,
    ) -> None:
        super().__init__(message)
        self.outcome = outcome
        self.sent = sent
        self.action = action
        self.reason = reason


@dataclass(frozen=True, slots=True)
class AttemptOutcome:
    """What an attempt brought, and what to do about it.

    ``accept`` it as the answer, ``retry`` after ``delay_s`` (all calls of the key wait where
    ``pause``), ``fail`` this call, or stop the sweep because the ``quota`` is exhausted or the
    endpoint ``refused`` the key or the model. ``name`` is its outcome in the calls table.
    Without a ``raw`` reply the attempt may have been ``charged`` all the same, and has the
    ``reason`` of ``reason_of`` where it is known.
    """

    action: Action
    name: str
    message: str | None = None
    reading: Reading = Reading("error")  # noqa: RUF009 # frozen
    delay_s: float | None = None
    pause: bool = False
    raw: RawReply | None = None
    charged: bool = True
    reason: str | None = None


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
    """Classify a reply by the rules of docs/models.md."""
    if raw.status == 200 and not isinstance(raw.payload, dict):
        why = f"the body is not a JSON object: {raw.excerpt}"
        return AttemptOutcome("retry", "bad_body", why, raw=raw)
    body = as_dict(raw.payload)
    reading = read_reply(wire, body)
    if raw.status != 200:
        reading = Reading("error", usage=reading.usage)  # which is billed
        return replace(judge_error(raw.error, wire), reading=reading, raw=raw)
    if reading.outcome not in ("error", "empty"):
        return AttemptOutcome("accept", reading.outcome, reading=reading, raw=raw)
    told = is_error(body.get("error")) or is_error(at(body, "choices.0.error"))
    if reading.outcome == "error" and not told and reading.finish_reason in BROKEN_OFF:
        why = f"the server broke its answer off (finish reason {reading.finish_reason})"
        return AttemptOutcome("retry", "server_error", why, reading, raw=raw)
    is_nothing = reading.outcome == "empty" and not any(body.get(name) for name in wire.members)
    # Also an error in another format's form, or in MiniMax's.
    failed = told or as_dict(body.get("base_resp")).get("status_code")
    if reading.outcome == "error" or (is_nothing and failed):
        error = replace(raw.error, status=status_within(raw.error))
        reading = replace(reading, outcome="error")
        return replace(judge_error(error, wire), reading=reading, raw=raw)
    if is_nothing:
        why = f"the body has nothing of an answer: {raw.excerpt}"
        return AttemptOutcome("retry", "bad_body", why, reading, raw=raw)
    return AttemptOutcome("accept", reading.outcome, reading=reading, raw=raw)


def status_within(error: ServerError) -> int:
    """Return the status that an error within a 200 stands for: 400 or 500 if nobody knows it."""
    numbers = [int(name) for name in error.names if re.fullmatch("[45][0-9][0-9]", name)]
    named = [status for name, status in WITHIN.items() if name in error.names]
    return next(iter([*numbers, *named]), 400 if error.names else 500)


def judge_error(error: ServerError, wire: WireFormat) -> AttemptOutcome:
    """Classify an error, whatever was asked for."""
    default = "server_error" if 500 <= error.status < 600 else "bad_request"
    name = wire.meaning(error) or known_meaning(error) or STATUSES.get(error.status, default)
    action = ACTIONS.get(name, "fail")
    tells = action == "retry" or (action == "quota" and is_per_day(error))
    return AttemptOutcome(
        action,
        name,
        f"HTTP {error.status}: {error.message}",
        delay_s=server_delay_s(error, wire) if tells else None,
        pause=name == "rate_limited",
    )


def server_delay_s(
    error: ServerError, wire: WireFormat, now: datetime | None = None
) -> float | None:
    """Return the delay in s that a failed reply asks for, None if it says nothing usable.

    Sources in order: ``retry-after-ms``, ``retry-after`` (seconds or HTTP date), a member of the
    error, "try again in 1.574s" or "retry after 5 minutes" in the message, and for a 429
    ``x-ratelimit-reset``. Of several values of a header the longest counts.
    """
    told = _IN_TEXT.search(error.message)
    parts = re.findall(_PART, told[1], re.I) if told else []
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
    """Return the time in s until a used-up limit is reset, 0 if it is not said.

    The header is a number of seconds, or a moment as Unix time in s or ms, as OpenRouter has it.
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


def reason_of(outcome: AttemptOutcome, url: str) -> str | None:
    """Return why all calls of a run would fare as this one to ``url``: a name of REASONS or UNSURE.

    None: they might not.
    """
    raw, name = outcome.raw, outcome.name
    if outcome.action == "refused":
        is_twice = name == "unknown_model" and _TWICE.search(urlsplit(url).path)
        return "path_twice" if is_twice else name
    if raw is None or name == "bad_prompt":
        return outcome.reason
    if name == "bad_body":
        return raw.kind
    if outcome.action == "fail":
        return "request" if raw.status in REQUEST_ITSELF else "other_format"
    is_told = is_error(as_dict(raw.payload).get("error"))
    if outcome.action == "retry" and raw.status == 200 and is_told and not raw.error.names:
        return "other_error"
    message = as_dict(at(raw.payload, "choices.0.message"))
    # Thoughts within the text are the model's choice, not the server's.
    is_apart = message and not as_text(message.get("content"))
    is_alone = name == "empty" and is_apart and outcome.reading.reasoning.strip()
    return "reasoning_alone" if is_alone else None


def why_refused(reason: str, entry: ModelEntry, outcome: AttemptOutcome) -> str:
    """Return a reason in words, with what to set and what came."""
    raw = outcome.raw
    why = REASONS["other_format" if reason == "text" else reason].format(
        place=entry.place,
        key=" or ".join(entry.key_envs) or f"`key_env` of {entry.place}",
        id=entry.id,
        format=entry.format,
        encoding=raw and raw.headers.get("content-encoding"),
        base_url=set_base_url(entry),
    )
    return f"{why} ({outcome.message or (raw and raw.excerpt)})"


def if_nobody(entry: ModelEntry) -> str:
    """Return what a user can do if no server answers."""
    what = PROVIDERS[entry.provider].if_nobody
    return f"{what}, or {set_base_url(entry)}; then run the same command again"


def set_base_url(entry: ModelEntry) -> str:
    """Return how a user corrects the base URL of an entry."""
    provider = PROVIDERS[entry.provider]
    if entry.base_url is not None or provider.base_url_env is None:
        return f"correct `base_url` of {entry.place}"
    path = urlsplit(provider.base_url).path
    ending = f" (with {path} at its end)" if path else ""
    return f"set {provider.base_url_env} to the base URL of the service{ending}, or unset it"
