"""Format generateContent of Gemini."""

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
