"""What both formats of OpenAI share: usage, errors and limits, also of servers that speak them."""

from __future__ import annotations

from collections.abc import Mapping
from datetime import datetime
from typing import Any

from merge_runner.llm.formats.base import Meaning, ServerError, WireFormat, as_count, as_dict
from merge_runner.llm.formats.delays import NONE_REMAINS, duration_s
from merge_runner.records import Usage

QUOTA = frozenset(
    {
        "insufficient_quota",
        "billing_hard_limit_reached",
        "credit_balance_exhausted",
        "organization_spend_limit_exceeded",
        "project_spend_limit_exceeded",
        "organization_usage_limit_exceeded",
        "budget_exceeded",  # LiteLLM's own
    }
)


class OpenAI(WireFormat):
    """A format of OpenAI, with the errors of Azure, OpenRouter and LiteLLM."""

    # Azure charges for a prompt that it has looked at, also where it then refuses it.
    charged_errors = frozenset({"content_filter", "context_length_exceeded"})

    def meaning(self, error: ServerError) -> Meaning | None:
        """Filters, quotas, unknown models and what can never be sent."""
        if _is_filtered(error):
            return "refusal"
        if _is_in_flight_budget(error):
            return "rate_limited"
        if error.names & QUOTA:
            return "quota_exhausted"
        if "model_not_found" in error.names and error.status in (400, 401, 403, 404):
            return "unknown_model"
        if error.status == 429 and error.message.startswith("Request too large"):
            return "request_too_large"
        if error.status == 400 and "invalid_prompt" in error.names:
            return "bad_prompt"
        return None

    def status_of(self, error: ServerError) -> int | None:
        """A failed response arrives with status 200."""
        if "rate_limit_exceeded" in error.names:
            return 429
        return 500 if error.names == {"server_error"} else None

    def reset_s(self, headers: Mapping[str, str], now: datetime) -> float | None:
        """The longest reset among the limits of which nothing remains."""
        delays = [
            duration_s(headers.get(f"x-ratelimit-reset-{kind}", ""))
            for kind in ("requests", "tokens")
            if NONE_REMAINS.fullmatch(headers.get(f"x-ratelimit-remaining-{kind}", ""))
        ]
        return max((delay for delay in delays if delay is not None), default=None)


def usage_of(payload: dict[str, Any], read: str, written: str) -> Usage:
    """The usage of an answer, by the format's words for what was read and written."""
    usage = as_dict(payload.get("usage"))
    read_details = as_dict(usage.get(f"{read}_tokens_details"))
    written_details = as_dict(usage.get(f"{written}_tokens_details"))
    return Usage(
        input_tokens=as_count(usage.get(f"{read}_tokens")),
        cached_input_tokens=as_count(read_details.get("cached_tokens")),
        output_tokens=as_count(usage.get(f"{written}_tokens")),
        reasoning_tokens=as_count(written_details.get("reasoning_tokens")),
    )


def _is_filtered(error: ServerError) -> bool:
    """Azure's content filter, or OpenRouter's moderation."""
    azure = error.status == 400 and "content_filter" in error.names
    return azure or (error.status == 403 and "flagged_input" in error.body)


def _is_in_flight_budget(error: ServerError) -> bool:
    """OpenRouter's 402 for want of credit while other requests run: it passes when they end."""
    in_flight = error.status == 402 and "openrouter_in_flight_budget" in error.body
    return in_flight and "retry-after" in error.headers
