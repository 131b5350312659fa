"""Formats of one provider each: OpenAI's responses, Gemini and Anthropic."""

from __future__ import annotations

from typing import Any, ClassVar

from merge_runner.llm.formats.wire import (
    REFUSALS,
    Reading,
    WireFormat,
    WireRequest,
    as_dicts,
    as_text,
    at,
    is_error,
    joined,
    outcome_of,
    plain,
    usage_of,
)
from merge_runner.providers import ModelEntry


class OpenAIResponses(WireFormat):
    """``POST /responses``, not stored at the provider."""

    parameters: ClassVar = {
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
        """Join the text parts of all messages; a failed response arrives with status 200.

        A commentary before the final message is reasoning.
        """
        items = as_dicts(payload.get("output"))
        messages = [item for item in items if item.get("type") == "message"]
        final = [item for item in messages if item.get("phase") != "commentary"] or messages
        parts = [part for item in final for part in as_dicts(item.get("content"))]
        text = joined(part for part in parts if part.get("type") == "output_text")
        reasoned = [item for item in items if item.get("type") == "reasoning"]
        reasoned += [item for item in messages if item not in final]
        members = (item.get(name) for item in reasoned for name in ("summary", "content"))
        thoughts = [joined(as_dicts(member)) for member in members]
        refusal = joined((part for part in parts if part.get("type") == "refusal"), "refusal")
        status = as_text(payload.get("status"))
        reason = as_text(at(payload, "incomplete_details.reason"))
        return Reading(
            outcome_of(
                text,
                failed=status == "failed" or is_error(payload.get("error")),
                truncated=status == "incomplete" or reason == "max_output_tokens",
                refused=reason == "content_filter" or bool(refusal),
            ),
            text or refusal,
            reason or status,
            as_text(payload.get("model")),
            usage_of(
                payload.get("usage"),
                input_tokens="input_tokens",
                cached_input_tokens="input_tokens_details.cached_tokens",
                output_tokens="output_tokens",
                reasoning_tokens="output_tokens_details.reasoning_tokens",
                total="total_tokens",
            ),
            reasoning="\n\n".join(filter(None, thoughts)),
            service_tier=as_text(payload.get("service_tier")),
        )


class GeminiGenerateContent(WireFormat):
    """``POST /v1beta/models/MODEL:generateContent``: the model is in the path alone.

    The parameters are members of ``generationConfig``.
    """

    parameters: ClassVar = {
        **plain("temperature", "seed", "responseMimeType", "responseSchema"),
        "top_p": ("topP",),
        "top_k": ("topK",),
        "thinking_budget": ("thinkingConfig", "thinkingBudget"),
        "thinking_level": ("thinkingConfig", "thinkingLevel"),
    }
    # A STOP without content is a known intermittent fault of Gemini 2.5 Pro.
    retries_empty = True
    members = frozenset({"candidates", "promptFeedback", "usageMetadata"})

    def request(self, entry: ModelEntry, prompt: str) -> WireRequest:
        """Return one user turn; the cap covers thoughts and visible tokens."""
        config = {"maxOutputTokens": entry.max_output_tokens, **entry.parameters}
        return WireRequest(
            path=entry.path or f"/v1beta/models/{entry.id}:generateContent",
            body={
                "contents": [{"role": "user", "parts": [{"text": prompt}]}],
                "generationConfig": config,
            },
        )

    def read(self, payload: dict[str, Any]) -> Reading:
        """Join the parts of the first candidate that are no thoughts."""
        parts = as_dicts(at(payload, "candidates.0.content.parts"))
        text = joined(part for part in parts if not part.get("thought"))
        finish = as_text(at(payload, "candidates.0.finishReason"))
        blocked = as_text(at(payload, "promptFeedback.blockReason"))
        return Reading(
            outcome_of(
                text,
                failed=is_error(payload.get("error")),
                truncated=finish == "MAX_TOKENS",
                refused=bool(blocked) or finish in REFUSALS,
            ),
            text,
            finish or blocked,
            as_text(payload.get("modelVersion")),
            usage_of(
                payload.get("usageMetadata"),
                input_tokens="promptTokenCount",
                cached_input_tokens="cachedContentTokenCount",
                output_tokens="candidatesTokenCount thoughtsTokenCount",
                reasoning_tokens="thoughtsTokenCount",
                total="totalTokenCount",
            ),
            reasoning=joined(part for part in parts if part.get("thought")),
            service_tier=(as_text(at(payload, "usageMetadata.serviceTier")) or "").lower() or None,
        )


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
