"""Messages format of Anthropic."""

from __future__ import annotations

from typing import Any, ClassVar

from merge_runner.llm.formats.wire import (
    Reading,
    WireFormat,
    WireRequest,
    as_dicts,
    as_text,
    joined,
    outcome_of,
    plain,
    usage_of,
)
from merge_runner.providers import ModelEntry


class AnthropicMessages(WireFormat):
    """``POST /v1/messages`` with the API version as a header."""

    parameters: ClassVar = {
        **plain("temperature", "top_p", "top_k", "thinking"),
        "reasoning_effort": ("output_config", "effort"),
    }
    members = frozenset({"content", "stop_reason"})
    # The version whose sampling default is temperature 1.0; later ones reject the parameter.
    headers: ClassVar = {"anthropic-version": "2023-06-01"}

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
        """Join the text blocks; thinking blocks are the reasoning."""
        blocks = as_dicts(payload.get("content"))
        text = joined(block for block in blocks if block.get("type") == "text")
        finish = as_text(payload.get("stop_reason"))
        cap = ("max_tokens", "model_context_window_exceeded")
        return Reading(
            outcome_of(
                text,
                failed=payload.get("type") == "error",
                truncated=finish in cap,
                refused=finish == "refusal",
            ),
            text,
            finish,
            as_text(payload.get("model")),
            usage_of(
                payload.get("usage"),
                # Anthropic counts cached tokens apart; here the input includes them.
                input_tokens="input_tokens cache_read_input_tokens cache_creation_input_tokens",
                cached_input_tokens="cache_read_input_tokens",
                output_tokens="output_tokens",
                reasoning_tokens="output_tokens_details.thinking_tokens",
            ),
            reasoning=joined(blocks, "thinking"),
        )
