"""Google Gemini generateContent."""

from __future__ import annotations

import re
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
    total,
)
from merge_runner.records import Usage

REFUSALS = frozenset(
    {
        "SAFETY",
        "RECITATION",
        "LANGUAGE",
        "OTHER",
        "BLOCKLIST",
        "PROHIBITED_CONTENT",
        "SPII",
        "MODEL_ARMOR",
    }
)
# A protobuf Duration as JSON.
DURATION = re.compile(r"(\d+(?:\.\d+)?)s")


class GeminiGenerateContent(WireFormat):
    """``POST /v1beta/models/MODEL:generateContent``: the model is in the path alone.

    The parameters are members of ``generationConfig``.
    """

    parameters = {  # noqa: RUF012 # never changed
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
        return WireRequest(
            path=entry.path or f"/v1beta/models/{entry.id}:generateContent",
            body={
                "contents": [{"role": "user", "parts": [{"text": prompt}]}],
                "generationConfig": {
                    "maxOutputTokens": entry.max_output_tokens,
                    **entry.parameters,
                },
            },
        )

    def read(self, payload: dict[str, Any]) -> Reading:
        """Join the parts of the first candidate that are no thoughts."""
        candidate = first_of(payload.get("candidates"))
        parts = as_dicts(as_dict(candidate.get("content")).get("parts"))
        text = joined(part for part in parts if not part.get("thought"))
        finish = as_text(candidate.get("finishReason"))
        blocked = as_text(as_dict(payload.get("promptFeedback")).get("blockReason"))
        usage = as_dict(payload.get("usageMetadata"))
        thoughts = as_count(usage.get("thoughtsTokenCount"))
        return Reading(
            outcome=outcome_of(
                text,
                failed=payload.get("error"),
                truncated=finish == "MAX_TOKENS",
                refused=bool(blocked) or finish in REFUSALS,
            ),
            text=text,
            finish_reason=finish or blocked,
            model_served=as_text(payload.get("modelVersion")),
            usage=Usage(
                input_tokens=as_count(usage.get("promptTokenCount")),
                cached_input_tokens=as_count(usage.get("cachedContentTokenCount")),
                output_tokens=total(as_count(usage.get("candidatesTokenCount")), thoughts),
                reasoning_tokens=thoughts,
            ),
        )

    def meaning(self, error: ServerError) -> Meaning | None:
        """Tell a quota per day, which has the words of one per minute and does not pass."""
        if error.status == 400 and "API_KEY_INVALID" in error.names:
            return "not_allowed"
        per_day = any(
            "PerDay" in str(violation.get("quotaId"))
            for detail in error.details
            for violation in as_dicts(detail.get("violations"))
        )
        return "quota_exhausted" if error.status == 429 and per_day else None

    def delay_s(self, error: ServerError) -> float | None:
        """Read the RetryInfo among the details."""
        for detail in error.details:
            match = DURATION.fullmatch(as_text(detail.get("retryDelay")) or "")
            if match:
                return float(match.group(1))
        return None
