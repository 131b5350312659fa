"""What both formats of OpenAI share: usage and errors, also of servers that speak them."""

from __future__ import annotations

from typing import Any

from merge_runner.llm.formats.base import Meaning, ServerError, WireFormat, as_count, as_dict
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

    def meaning(self, error: ServerError) -> Meaning | None:
        """Filters, quotas, unknown models and what can never be sent."""
        # Azure's content filter, and OpenRouter's moderation.
        if error.status == 400 and "content_filter" in error.names:
            return "refusal"
        if error.status == 403 and "flagged_input" in error.body:
            return "refusal"
        # OpenRouter's want of credit while other requests run: it passes when they end.
        in_flight = error.status == 402 and "openrouter_in_flight_budget" in error.body
        if in_flight and "retry-after" in error.headers:
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
