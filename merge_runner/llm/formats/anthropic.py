"""Anthropic Messages."""

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
    joined,
    outcome_of,
    plain,
    total,
)
from merge_runner.records import Usage

# The version whose sampling default is temperature 1.0; later ones reject the parameter.
VERSION = "2023-06-01"
QUOTA = frozenset({"enforced_spend_limit_reached", "contract_spend_limit_reached"})
# These are reported as invalid requests.
SPENT = ("credit balance is too low", "spend limit")


class AnthropicMessages(WireFormat):
    """``POST /v1/messages`` with the API version as a header."""

    parameters = {  # noqa: RUF012 # never changed
        **plain("temperature", "top_p", "top_k", "thinking"),
        "reasoning_effort": ("output_config", "effort"),
    }
    members = frozenset({"content", "stop_reason"})
    headers = {"anthropic-version": VERSION}  # noqa: RUF012 # never changed

    def request(self, entry: ModelEntry, prompt: str) -> WireRequest:
        """Return one user message; ``max_tokens`` is required."""
        return WireRequest(
            path=entry.path or "/v1/messages",
            body={
                "model": entry.id,
                "max_tokens": entry.max_output_tokens,
                "messages": [{"role": "user", "content": prompt}],
                **entry.parameters,
            },
            headers=dict(self.headers),
        )

    def read(self, payload: dict[str, Any]) -> Reading:
        """Join the text blocks; thinking blocks are left out."""
        blocks = as_dicts(payload.get("content"))
        text = joined(block for block in blocks if block.get("type") == "text")
        finish = as_text(payload.get("stop_reason"))
        usage = as_dict(payload.get("usage"))
        cached = as_count(usage.get("cache_read_input_tokens"))
        return Reading(
            outcome=outcome_of(
                text,
                failed=payload.get("type") == "error",
                truncated=finish in ("max_tokens", "model_context_window_exceeded"),
                refused=finish == "refusal",
            ),
            text=text,
            finish_reason=finish,
            model_served=as_text(payload.get("model")),
            usage=Usage(
                # Anthropic counts cached tokens apart; here the input includes them.
                input_tokens=total(
                    as_count(usage.get("input_tokens")),
                    cached,
                    as_count(usage.get("cache_creation_input_tokens")),
                ),
                cached_input_tokens=cached,
                output_tokens=as_count(usage.get("output_tokens")),
                reasoning_tokens=as_count(
                    as_dict(usage.get("output_tokens_details")).get("thinking_tokens")
                ),
            ),
        )

    def meaning(self, error: ServerError) -> Meaning | None:
        """Tell a spend limit, also from an invalid request."""
        spent = error.status == 400 and any(words in error.message for words in SPENT)
        return "quota_exhausted" if spent or error.names & QUOTA else None
