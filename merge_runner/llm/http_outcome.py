"""Outcome of an attempt, from a raw HTTP reply: an answer, a retry, or a reason to stop.

``judge`` classifies a reply by itself; ``EndpointState`` decides what follows for its call and run.
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Literal, NamedTuple

from merge_runner.errors import MergeRunnerError
from merge_runner.llm.delays import server_delay_s
from merge_runner.llm.formats.server_error import ServerError, is_per_day, known_meaning, read_error
from merge_runner.llm.formats.wire import (
    BROKEN_OFF,
    Reading,
    WireFormat,
    as_dict,
    at,
    is_error,
    read_reply,
)
from merge_runner.providers import PROVIDERS

Action = Literal["accept", "retry", "fail", "quota", "rejected"]
EXCERPT = 200
# Azure bills a prompt that it has checked, even where it then refuses it.
CHARGED_ERRORS = frozenset({"content_filter", "context_length_exceeded"})
TOO_LATE = frozenset({408, 499, 504, 524})

# Meaning of a status unless a format overrides it; any other 5xx is transient, and any other status
# means a bad request.
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
# Statuses of named errors without a number in a reply of status 200; the first match counts.
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
# Action after an outcome; any other outcome fails its call.
ACTIONS: dict[str, Action] = {
    "refusal": "accept",
    "quota_exhausted": "quota",
    "not_allowed": "rejected",
    "unknown_model": "rejected",
    "proxy_refused": "rejected",
    **dict.fromkeys(("rate_limited", "request_timeout", "conflict"), "retry"),
    **dict.fromkeys(("server_error", "overloaded", "server_timeout"), "retry"),
}

# After comments and other fields, since a plain text may begin with "id:", too.
_EVENTS = re.compile(r"\s*(?:(?:id|retry)?:[^\n]*\n\s*)*(?:data|event):", re.ASCII)


@dataclass(frozen=True)
class RawReply:
    """A reply as received: ``headers`` with lower-case names, and the text of its ``body``."""

    status: int
    headers: Mapping[str, str]
    body: str

    @cached_property
    def payload(self) -> object:
        """The body as JSON, parsed once; None if it is not JSON.

        Gemini may wrap an error in a list, which is removed.
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
        """True where the body is HTML, which no API sends."""
        return self.body.lstrip("\ufeff \t\r\n")[:9].lower().startswith(("<!doctype", "<html"))

    @property
    def kind(self) -> str:
        """Kind of a body that is no answer: a name of ``endpoint_state.REASONS``, or ``text``."""
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
        """Content type and beginning of the body, in one line."""
        words = " ".join(self.body[:EXCERPT].split()) or "an empty body"
        return f"{self.headers.get('content-type', 'no content type')}: {words}"

    def _is(self, header: str, value: str) -> bool:
        return self.headers.get(header, "").lower().strip().startswith(value)


class TransportFailure(MergeRunnerError):
    """An attempt without a reply, with its ``outcome``.

    ``sent`` is False if the request was certainly not sent, and so cannot be billed.
    """

    def __init__(
        self,
        name: str,
        message: str,
        *,
        sent: bool = True,
        action: Action = "retry",
        reason: str | None = None,
    ) -> None:
        super().__init__(message)
        self.outcome = AttemptOutcome(action, name, message, charged=sent, reason=reason)


class AttemptOutcome(NamedTuple):
    """Outcome of an attempt, by its ``name`` in the table of calls, and the action that follows.

    ``accept`` it as the answer, ``retry`` after ``delay_s`` (``pause``: all calls to the endpoint
    wait), ``fail`` this call, or stop the sweep because the ``quota`` is exhausted or the endpoint
    has ``rejected`` the key or the model. Without a ``raw`` reply, ``charged`` says whether the
    attempt may have been billed, and ``reason``, of ``endpoint_state.REASONS``, why there is none.
    """

    action: Action
    name: str
    message: str | None = None
    reading: Reading = Reading("error")
    delay_s: float | None = None
    pause: bool = False
    raw: RawReply | None = None
    charged: bool = True
    reason: str | None = None


def may_be_charged(raw: RawReply, endpoint: str) -> bool:
    """Return whether a reply without usage may have been billed.

    Not billed are refusals before any work, and errors that a provider's own host sends in the
    documented form: ``endpoint`` is an ``Endpoint.identity``, a provider's name only at that host.
    An error of a gateway, or a timeout, may follow a generated answer.
    """
    provider = PROVIDERS.get(endpoint)
    if raw.status < 300 or raw.status in TOO_LATE or '"usage' in raw.body:
        return True
    if raw.status < 500:
        return provider is None and bool(raw.error.names & CHARGED_ERRORS)
    members = provider.error_members if provider else frozenset()
    return not members or not members <= as_dict(as_dict(raw.payload).get("error")).keys()


def judge(raw: RawReply, wire: WireFormat) -> AttemptOutcome:
    """Classify a reply by the rules of docs/models.md."""
    if raw.status == 200 and not isinstance(raw.payload, dict):
        why = f"the body is not a JSON object: {raw.excerpt}"
        return AttemptOutcome("retry", "bad_body", why, raw=raw)
    body = as_dict(raw.payload)
    reading = read_reply(wire, body)
    if raw.status != 200:
        reading = Reading("error", usage=reading.usage)  # usage is billed
        return judge_error(raw.error, wire)._replace(reading=reading, raw=raw)
    if reading.outcome not in ("error", "empty"):
        return AttemptOutcome("accept", reading.outcome, reading=reading, raw=raw)
    has_error = is_error(body.get("error")) or is_error(at(body, "choices.0.error"))
    if reading.outcome == "error" and not has_error and reading.finish_reason in BROKEN_OFF:
        why = f"the server broke its reply off (finish reason {reading.finish_reason})"
        return AttemptOutcome("retry", "server_error", why, reading, raw=raw)
    is_nothing = reading.outcome == "empty" and not any(body.get(name) for name in wire.members)
    # Also an error in another format's form, or in MiniMax's.
    failed = has_error or as_dict(body.get("base_resp")).get("status_code")
    if reading.outcome == "error" or (is_nothing and failed):
        error = raw.error._replace(status=status_within(raw.error))
        reading = reading._replace(outcome="error")
        return judge_error(error, wire)._replace(reading=reading, raw=raw)
    if is_nothing:
        why = f"the body has nothing of a reply: {raw.excerpt}"
        return AttemptOutcome("retry", "bad_body", why, reading, raw=raw)
    return AttemptOutcome("accept", reading.outcome, reading=reading, raw=raw)


def status_within(error: ServerError) -> int:
    """Return the status of an error within a 200; by default 400 if it has names, else 500."""
    numbers = [int(name) for name in error.names if re.fullmatch("[45][0-9][0-9]", name)]
    named = [status for name, status in WITHIN.items() if name in error.names]
    return next(iter([*numbers, *named]), 400 if error.names else 500)


def judge_error(error: ServerError, wire: WireFormat) -> AttemptOutcome:
    """Classify an error, of a call or of a batch mode."""
    default = "server_error" if 500 <= error.status < 600 else "bad_request"
    name = wire.meaning(error) or known_meaning(error) or STATUSES.get(error.status, default)
    action = ACTIONS.get(name, "fail")
    may_delay = action == "retry" or (action == "quota" and is_per_day(error))
    return AttemptOutcome(
        action,
        name,
        f"HTTP {error.status}: {error.message}",
        delay_s=server_delay_s(error, wire) if may_delay else None,
        pause=name == "rate_limited",
    )
