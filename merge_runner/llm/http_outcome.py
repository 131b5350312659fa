"""What a raw HTTP reply means: an answer, something to try again, or a reason to stop."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, Literal

from merge_runner.llm.delays import server_delay_s
from merge_runner.llm.formats.base import (
    ErrorInfo,
    Reading,
    WireFormat,
    as_dict,
    as_list,
    error_info,
    is_answer,
)

Action = Literal["accept", "retry", "fail", "quota", "refused"]

QUOTA_CODES = frozenset(
    {
        "insufficient_quota",
        "billing_hard_limit_reached",
        "credit_balance_exhausted",
        "organization_spend_limit_exceeded",
        "project_spend_limit_exceeded",
        "organization_usage_limit_exceeded",
        "enforced_spend_limit_reached",
        "contract_spend_limit_reached",
        "budget_exceeded",
    }
)
# Anthropic reports these as invalid requests.
SPENT = ("credit balance is too low", "spend limit")
TOO_LATE = frozenset({408, 499, 504, 524})
# Azure charges for a prompt that it has looked at, also where it then refuses it with status 400.
LOOKED_AT = frozenset({"content_filter", "context_length_exceeded"})
TRANSIENT = {
    408: "request_timeout",
    409: "conflict",
    500: "server_error",
    502: "server_error",
    503: "overloaded",
    504: "server_timeout",
    520: "server_error",
    521: "server_error",
    522: "server_error",
    523: "server_error",
    524: "server_timeout",
    529: "overloaded",
}


@dataclass(frozen=True, slots=True)
class RawReply:
    """A reply as received: ``headers`` have lower-case names, ``body`` is the text."""

    status: int
    headers: Mapping[str, str]
    body: str


@dataclass(frozen=True, slots=True)
class Verdict:
    """What to do with a reply.

    ``accept`` it as the answer, ``retry`` after ``delay_s`` (all calls of the key wait where
    ``pause``), ``fail`` this call, or stop the sweep because the ``quota`` is exhausted or the
    endpoint ``refused`` the key or the model. ``outcome`` names it in the calls table.
    """

    action: Action
    outcome: str
    reading: Reading
    message: str | None = None
    delay_s: float | None = None
    pause: bool = False


def may_be_charged(raw: RawReply, provider: str | None) -> bool:
    """Whether a reply that tells no usage may stand for work that is charged.

    A refusal before any work is not, nor an error in the documented form of the ``provider`` whose
    own host answered (None: another server). That of a gateway, or one for want of time, may
    follow an answer that was made.
    """
    payload = _first(_json(raw.body))
    if raw.status < 300 or raw.status in TOO_LATE or '"usage' in raw.body:
        return True
    if raw.status >= 500:
        return provider is None or not _in_its_form(provider, as_dict(payload))
    return provider is None and bool(error_info(payload, "").names & LOOKED_AT)


def is_web_page(raw: RawReply) -> bool:
    """Whether what answers is a web site: no service of any format sends this as an answer."""
    return raw.body.lstrip("\ufeff \t\r\n")[:9].lower().startswith(("<!doctype", "<html"))


def _in_its_form(provider: str, payload: dict[str, Any]) -> bool:
    """Whether an error has the members that the provider documents for all of its own."""
    error = as_dict(payload.get("error"))
    members = {
        "openai": {"message", "type", "code"},
        "gemini": {"message", "code", "status"},
        "anthropic": {"message", "type"},
        "openrouter": {"message", "code"},
    }.get(provider)
    return members is not None and members <= error.keys()


def judge(raw: RawReply, wire: WireFormat) -> Verdict:
    """The verdict on a reply, by the rules of docs/reference/providers.md."""
    payload = _json(raw.body)
    if raw.status == 200:
        return _judge_success(raw, payload, wire)
    payload = _first(payload)
    verdict = _judge_error(raw.status, raw, payload)
    # What an error says to have used is billed.
    usage = wire.read(as_dict(payload)).usage
    return replace(verdict, reading=replace(verdict.reading, usage=usage))


def _first(payload: object) -> object:
    """Gemini wraps its errors in a list where it streams."""
    if isinstance(payload, list):
        return payload[0] if payload else None
    return payload


def _json(body: str) -> object:
    try:
        return json.loads(body)
    except (ValueError, RecursionError):  # the latter: nested beyond any honest reply
        return None


def _judge_success(raw: RawReply, payload: object, wire: WireFormat) -> Verdict:
    if not isinstance(payload, dict):
        return Verdict("retry", "bad_body", Reading("error"), "the body is not a JSON object")
    reading = wire.read(payload)
    if reading.outcome == "empty" and not is_answer(payload, wire.members):
        return Verdict("retry", "bad_body", reading, "the body has nothing of an answer")
    if reading.outcome != "error":
        return Verdict("accept", reading.outcome, reading)
    return replace(_judge_error(_status_within(payload, raw), raw, payload), reading=reading)


def _status_within(payload: object, raw: RawReply) -> int:
    """The status that an error within a 200 stands for."""
    names = error_info(payload, raw.body).names
    if "rate_limit_exceeded" in names:
        return 429
    numbers = [int(name) for name in names if re.fullmatch("[45][0-9][0-9]", name)]
    return numbers[0] if numbers else 400 if names - {"server_error"} else 500


def _judge_error(status: int, raw: RawReply, payload: object) -> Verdict:
    error = error_info(payload, raw.body)
    delay = server_delay_s(raw.headers, payload)
    should_retry = raw.headers.get("x-should-retry")
    message = f"HTTP {status}: {error.message}"
    reading = Reading("error")
    moderated = status == 403 and "flagged_input" in raw.body  # as OpenRouter says it
    if moderated or (status == 400 and "content_filter" in error.names):
        return Verdict("accept", "refusal", Reading("refusal"), message)
    if _quota_exhausted(status, raw, error):
        return Verdict("quota", "quota_exhausted", reading, message)
    if _endpoint_refuses(status, error) and should_retry != "true":
        outcome = "unknown_model" if _names_model(status, error) else "not_allowed"
        return Verdict("refused", outcome, reading, message)
    if status in (402, 429):
        if error.message.startswith("Request too large"):
            return Verdict("fail", "request_too_large", reading, message)
        action: Action = "fail" if should_retry == "false" else "retry"
        return Verdict(action, "rate_limited", reading, message, delay, pause=action == "retry")
    if should_retry == "true" or (status in TRANSIENT and should_retry != "false"):
        outcome = TRANSIENT.get(status, f"http_{status}")
        return Verdict("retry", outcome, reading, message, delay)
    return Verdict("fail", TRANSIENT.get(status, "bad_request"), reading, message)


def _quota_exhausted(status: int, raw: RawReply, error: ErrorInfo) -> bool:
    if status == 402:
        in_flight_only = "openrouter_in_flight_budget" in raw.body
        return not (in_flight_only and "retry-after" in raw.headers)
    if error.names & QUOTA_CODES:
        return True
    if status == 400:
        return any(words in error.message for words in SPENT)
    per_day = any(
        "PerDay" in str(as_dict(violation).get("quotaId"))
        for detail in error.details
        for violation in as_list(detail.get("violations"))
    )
    return status == 429 and per_day


def _endpoint_refuses(status: int, error: ErrorInfo) -> bool:
    return status in (401, 403, 404) or (
        status == 400 and bool(error.names & {"model_not_found", "API_KEY_INVALID"})
    )


def _names_model(status: int, error: ErrorInfo) -> bool:
    return status == 404 or "model_not_found" in error.names
