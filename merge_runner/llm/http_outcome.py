"""What a raw HTTP reply means: an answer, something to try again, or a reason to stop."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal

from merge_runner.config import PROVIDERS
from merge_runner.errors import MergeRunnerError
from merge_runner.llm.formats import PASSED_ON
from merge_runner.llm.formats.base import (
    Reading,
    ServerError,
    WireFormat,
    as_dict,
    is_answer,
    read_error,
)
from merge_runner.llm.formats.delays import server_delay_s

Action = Literal["accept", "retry", "fail", "quota", "refused"]
NOTHING_READ = Reading("error")

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
    **dict.fromkeys(
        (
            "rate_limited",
            "request_timeout",
            "conflict",
            "server_error",
            "overloaded",
            "server_timeout",
        ),
        "retry",
    ),
}


@dataclass(frozen=True)
class RawReply:
    """A reply as received: ``headers`` have lower-case names, ``body`` is the text."""

    status: int
    headers: Mapping[str, str]
    body: str

    @cached_property
    def payload(self) -> object:
        """The body as JSON, read once; None where it is none."""
        try:
            payload: object = json.loads(self.body)
        except (ValueError, RecursionError):  # the latter: nested beyond any honest reply
            return None
        return payload

    @cached_property
    def error(self) -> ServerError:
        """The body as an error."""
        return read_error(self.status, self.headers, self.body, self.first)

    @property
    def first(self) -> object:
        """The body without the list into which Gemini wraps its errors where it streams."""
        if isinstance(self.payload, list):
            return self.payload[0] if self.payload else None
        return self.payload


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


class ErrorReply(MergeRunnerError):
    """The server replied with an error in place of what it was asked for."""

    def __init__(self, raw: RawReply) -> None:
        super().__init__(f"HTTP {raw.status}: {raw.error.message}")
        self.raw = raw


@dataclass(frozen=True, slots=True)
class AttemptOutcome:
    """What an attempt brought, and what to do about it.

    ``accept`` it as the answer, ``retry`` after ``delay_s`` (all calls of the key wait where
    ``pause``), ``fail`` this call, or stop the sweep because the ``quota`` is exhausted or the
    endpoint ``refused`` the key or the model. ``name`` is its outcome in the calls table.
    ``of_prompt`` says that a failure is of this prompt alone.
    """

    action: Action
    name: str
    message: str | None = None
    reading: Reading = NOTHING_READ
    delay_s: float | None = None
    pause: bool = False
    of_prompt: bool = False


def may_be_charged(raw: RawReply, provider: str | None) -> bool:
    """Whether a reply that tells no usage may stand for work that is charged.

    A refusal before any work is not, nor an error in the documented form of the ``provider`` whose
    own host answered (None: another server). That of a gateway, or one for want of time, may
    follow an answer that was made.
    """
    if raw.status < 300 or raw.status in TOO_LATE or '"usage' in raw.body:
        return True
    if raw.status >= 500:
        return provider is None or not _in_its_form(provider, raw)
    return provider is None and bool(raw.error.names & CHARGED_ERRORS)


def is_web_page(raw: RawReply) -> bool:
    """Whether a web site answers: no service of any format sends this as an answer."""
    return raw.body.lstrip("\ufeff \t\r\n")[:9].lower().startswith(("<!doctype", "<html"))


def _in_its_form(provider: str, raw: RawReply) -> bool:
    """Whether an error has the members that the provider documents for all of its own."""
    members = PROVIDERS[provider].error_members
    return bool(members) and members <= as_dict(as_dict(raw.first).get("error")).keys()


def judge(raw: RawReply, wire: WireFormat) -> AttemptOutcome:
    """What a reply means, by the rules of docs/reference/providers.md."""
    if raw.status == 200:
        return _judge_success(raw, wire)
    outcome = judge_error(raw.error, wire)
    # The usage that an error states is billed.
    usage = wire.read(as_dict(raw.first)).usage
    return replace(outcome, reading=replace(outcome.reading, usage=usage))


def _judge_success(raw: RawReply, wire: WireFormat) -> AttemptOutcome:
    if not isinstance(raw.payload, dict):
        return AttemptOutcome("retry", "bad_body", "the body is not a JSON object")
    reading = wire.read(raw.payload)
    if reading.outcome == "empty" and not is_answer(raw.payload, wire.members):
        return AttemptOutcome("retry", "bad_body", "the body has nothing of an answer", reading)
    if reading.outcome != "error":
        return AttemptOutcome("accept", reading.outcome, reading=reading)
    error = replace(raw.error, status=status_within(raw.error))
    return replace(judge_error(error, wire), reading=reading)


def status_within(error: ServerError) -> int:
    """The status that an error within a 200 stands for: 400 or 500 if nobody knows it."""
    if "rate_limit_exceeded" in error.names:
        return 429
    if error.names == {"server_error"}:
        return 500
    numbers = [int(name) for name in error.names if re.fullmatch("[45][0-9][0-9]", name)]
    return numbers[0] if numbers else 400 if error.names else 500


def judge_error(error: ServerError, wire: WireFormat) -> AttemptOutcome:
    """What an error means, whatever was asked for."""
    # What a format knows of an error, else what a format knows that gateways pass on.
    told = filter(None, (each.meaning(error) for each in (wire, *PASSED_ON)))
    name: str = next(told, None) or STATUSES.get(error.status, "bad_request")
    action = ACTIONS.get(name, "fail")
    wish = error.headers.get("x-should-retry")
    if wish == "true" and action in ("fail", "refused") and name != "request_too_large":
        action, name = "retry", f"http_{error.status}"
    elif wish == "false" and action == "retry":
        action = "fail"
    of_prompt = name == "bad_prompt"
    return AttemptOutcome(
        action,
        "bad_request" if of_prompt else name,
        f"HTTP {error.status}: {error.message}",
        Reading(name) if name == "refusal" else NOTHING_READ,
        server_delay_s(error, (wire, *PASSED_ON)) if action == "retry" else None,
        pause=action == "retry" and name == "rate_limited",
        of_prompt=of_prompt,
    )
