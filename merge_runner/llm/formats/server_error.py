"""Errors of servers: read any known shape, and find the meaning of names and messages."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any, NamedTuple

from merge_runner.llm.formats.wire import as_dict, as_dicts, as_text, at

# Names of an exhausted quota at OpenAI, LiteLLM (the eighth), Anthropic, Moonshot and MiniMax.
QUOTA = {
    *("insufficient_quota", "billing_hard_limit_reached", "credit_balance_exhausted"),
    *("organization_spend_limit_exceeded", "project_spend_limit_exceeded"),
    *("organization_usage_limit_exceeded", "billing_not_active", "budget_exceeded"),
    *("enforced_spend_limit_reached", "contract_spend_limit_reached"),
    *("exceeded_current_quota_error", "base_resp 1008"),
}
# Messages of one under another name. Anthropic reports the first three as invalid requests; the
# last one is OpenRouter's limit of a key.
SPENT = re.compile(
    "credit balance is too low|spend limit|reached your specified API usage limits"
    "|insufficient (account |user )?balance|balance is (insufficient|not enough)"
    "|check your billing details on our website|key limit exceeded",
    re.IGNORECASE,
)
# A daily limit at OpenAI, Groq and OpenRouter.
PER_DAY = re.compile(r"per[-_ ]?day\b|\b[rt]pd\b|\bdaily\b", re.IGNORECASE)
# An error that also names one of these may list all limits, and mean a shorter one.
SHORTER = re.compile(r"per[-_ ]?(min|sec|hour)|\b[rt]pm\b", re.IGNORECASE)
# A protobuf Duration as JSON.
DURATION = re.compile(r"(\d+(?:\.\d+)?)s")


class ServerError(NamedTuple):
    """An error in one shape: servers send nested, flat, listed and string errors.

    ``status`` is the reply's status, or the equivalent of an error within a 200. ``names`` are its
    type, its code, its status in words and the reasons among its ``details``.
    """

    status: int
    headers: Mapping[str, str]
    body: str
    message: str
    names: frozenset[str]
    details: tuple[dict[str, Any], ...]


def read_error(status: int, headers: Mapping[str, str], body: str, payload: object) -> ServerError:
    """Read an error body of any known shape; a body that is not JSON is its own message."""
    top = as_dict(payload)
    nested = top.get("error") if top.get("error") is not None else at(top, "choices.0.error")
    error = as_dict(nested) or ({"message": nested} if isinstance(nested, str) else top)
    details = as_dicts(error.get("details")) or [as_dict(error.get("details"))]
    names = [error.get(name) for name in ("type", "code", "status")]
    names += [detail.get(name) for detail in details for name in ("error_code", "reason")]
    known = {str(name) for name in names if name is not None}
    minimax = as_dict(top.get("base_resp"))
    known |= {f"base_resp {code}" for code in [minimax.get("status_code")] if code}
    words = as_text(error.get("message")) or as_text(minimax.get("status_msg")) or body[:200]
    # Users read one line; Gemini's message has several.
    message = " ".join(words.split()) or "no reason is given"
    passed_on = as_dict(as_dict(error.get("metadata")).get("headers"))  # by OpenRouter
    all_headers = {**{name.lower(): str(value) for name, value in passed_on.items()}, **headers}
    return ServerError(status, all_headers, body, message, frozenset(known), tuple(details))


def is_per_day(error: ServerError) -> bool:
    """Return whether an error names a daily limit alone; Gemini's messages do not show it."""
    words = " ".join((error.message, *error.names))
    return bool(error.status == 429 and PER_DAY.search(words) and not SHORTER.search(words))


def known_meaning(error: ServerError) -> str | None:
    """Return the meaning of an error of a known service or gateway, as ``WireFormat.meaning`` does.

    The format of a plug-in defines its meanings itself, and so changes no other format's replies.
    """
    names, words = error.names, error.message
    violations = [v for detail in error.details for v in as_dicts(detail.get("violations"))]
    per_day = any("PerDay" in str(violation.get("quotaId")) for violation in violations)
    is_transient = "openrouter_in_flight_budget" in error.body and "retry-after" in error.headers
    cases = (
        # Azure's content filter, and OpenRouter's moderation.
        (400, "content_filter" in names, "refusal"),
        (403, "flagged_input" in error.body, "refusal"),
        (400, "invalid_prompt" in names, "bad_prompt"),  # first, since it may quote the prompt
        # OpenRouter's lack of credit while other requests run: transient.
        (402, is_transient, "rate_limited"),
        (error.status, bool(names & QUOTA), "quota_exhausted"),
        *((code, SPENT.search(words), "quota_exhausted") for code in (400, 403, 429)),
        # Gemini's daily quota has the message of one per minute, but is not transient.
        (429, per_day or is_per_day(error), "quota_exhausted"),
        *((code, "model_not_found" in names, "unknown_model") for code in (400, 401, 403, 404)),
        (429, words.startswith("Request too large"), "request_too_large"),
        (400, "API_KEY_INVALID" in names, "not_allowed"),
    )
    meanings = (meaning for status, applies, meaning in cases if applies and status == error.status)
    return next(meanings, None)


def known_delay_s(error: ServerError) -> float | None:
    """Return the delay in s of Gemini's RetryInfo, one of the details."""
    for detail in error.details:
        if delay := DURATION.fullmatch(as_text(detail.get("retryDelay")) or ""):
            return float(delay[1])
    return None
