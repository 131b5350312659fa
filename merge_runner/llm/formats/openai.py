"""OpenAI Chat Completions, Responses, and the many servers that speak them."""

from __future__ import annotations

from typing import Any

from merge_runner.config import ModelEntry
from merge_runner.llm.formats.base import (
    Meaning,
    Reading,
    ServerError,
    WireFormat,
    WireRequest,
    as_count,
    as_dict,
    as_dicts,
    as_text,
    first_of,
    joined,
    outcome_of,
    plain,
)
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
        """Tell filters, quotas, unknown models and what can never be sent."""
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


class OpenAIChat(OpenAI):
    """``POST /chat/completions``; the path can be overridden, as Azure's classic form needs."""

    parameters = plain(
        "temperature",
        "top_p",
        "seed",
        "presence_penalty",
        "frequency_penalty",
        "reasoning_effort",
        "verbosity",
        "response_format",
    )
    members = frozenset({"choices"})

    def request(self, entry: ModelEntry, prompt: str) -> WireRequest:
        """Return one user message; the cap covers reasoning and visible tokens."""
        return WireRequest(
            path=entry.path or "/chat/completions",
            body={
                "model": entry.id,
                "messages": [{"role": "user", "content": prompt}],
                entry.cap_field: entry.max_output_tokens,
                **entry.parameters,
            },
        )

    def read(self, payload: dict[str, Any]) -> Reading:
        """Read the first choice."""
        choice = first_of(payload.get("choices"))
        message = as_dict(choice.get("message"))
        finish = as_text(choice.get("finish_reason"))
        content = message.get("content")  # a list of parts at some servers
        text = content if isinstance(content, str) else joined(as_dicts(content))
        refusal = as_text(message.get("refusal"))
        # Routers answer 200 and put the failure of a generation into the body.
        failed = payload.get("error") or choice.get("error") or finish == "error"
        return Reading(
            outcome=outcome_of(
                text,
                failed=failed,
                truncated=finish == "length",
                refused=bool(refusal) or finish == "content_filter",
            ),
            text=text or refusal or "",
            finish_reason=finish,
            model_served=as_text(payload.get("model")),
            usage=_usage(payload, "prompt", "completion"),
        )


class OpenAIResponses(OpenAI):
    """``POST /responses``, not stored at the provider."""

    parameters = {  # noqa: RUF012 # never changed
        **plain("temperature", "top_p"),
        "reasoning_effort": ("reasoning", "effort"),
        "verbosity": ("text", "verbosity"),
    }
    members = frozenset({"output", "status"})

    def request(self, entry: ModelEntry, prompt: str) -> WireRequest:
        """Return the prompt as the whole input; the cap covers reasoning and visible tokens."""
        return WireRequest(
            path=entry.path or "/responses",
            body={
                "model": entry.id,
                "input": prompt,
                "max_output_tokens": entry.max_output_tokens,
                "store": False,
                **entry.parameters,
            },
        )

    def read(self, payload: dict[str, Any]) -> Reading:
        """Join the text parts of all messages; a failed response arrives with status 200."""
        parts = [
            part
            for item in as_dicts(payload.get("output"))
            if item.get("type") == "message"
            for part in as_dicts(item.get("content"))
        ]
        text = joined(part for part in parts if part.get("type") == "output_text")
        refusal = joined((part for part in parts if part.get("type") == "refusal"), "refusal")
        status = as_text(payload.get("status"))
        reason = as_text(as_dict(payload.get("incomplete_details")).get("reason"))
        return Reading(
            outcome=outcome_of(
                text,
                failed=status == "failed" or payload.get("error"),
                truncated=reason == "max_output_tokens" or status == "incomplete",
                refused=bool(refusal) or reason == "content_filter",
            ),
            text=text or refusal,
            finish_reason=reason or status,
            model_served=as_text(payload.get("model")),
            usage=_usage(payload, "input", "output"),
        )


def _usage(payload: dict[str, Any], read: str, written: str) -> Usage:
    """Return the usage of an answer, by the format's words for what was read and written."""
    usage = as_dict(payload.get("usage"))
    read_details = as_dict(usage.get(f"{read}_tokens_details"))
    written_details = as_dict(usage.get(f"{written}_tokens_details"))
    return Usage(
        input_tokens=as_count(usage.get(f"{read}_tokens")),
        cached_input_tokens=as_count(read_details.get("cached_tokens")),
        output_tokens=as_count(usage.get(f"{written}_tokens")),
        reasoning_tokens=as_count(written_details.get("reasoning_tokens")),
    )
