"""The four built-in formats: those of OpenAI and the many servers that speak them, and two more."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any, ClassVar

from merge_runner.config import ModelEntry
from merge_runner.llm.formats.base import (
    Reading,
    ServerError,
    WireFormat,
    WireRequest,
    as_count,
    as_dicts,
    as_text,
    at,
    joined,
    outcome_of,
)
from merge_runner.records import Usage

# How an error names an exhausted quota: at OpenAI, LiteLLM (the seventh) and Anthropic.
QUOTA = {
    *("insufficient_quota", "billing_hard_limit_reached", "credit_balance_exhausted"),
    *("organization_spend_limit_exceeded", "project_spend_limit_exceeded"),
    *("organization_usage_limit_exceeded", "budget_exceeded"),
    *("enforced_spend_limit_reached", "contract_spend_limit_reached"),
}
# Anthropic reports these as invalid requests.
SPENT = ("credit balance is too low", "spend limit")
# What ends an answer of Gemini that was refused.
REFUSALS = (
    *("SAFETY", "RECITATION", "LANGUAGE", "OTHER", "BLOCKLIST", "PROHIBITED_CONTENT", "SPII"),
    "MODEL_ARMOR",
)
# A protobuf Duration as JSON.
DURATION = re.compile(r"(\d+(?:\.\d+)?)s")


def plain(*names: str) -> dict[str, tuple[str, ...]]:
    """Return parameters that stand at the top, under their common names."""
    return {name: (name,) for name in names}


class BuiltIn(WireFormat):
    """A format of which a table says where the counts and the model's name stand in an answer.

    Gateways pass on the errors of others, so that each of these formats reads those of all.
    """

    model_at: ClassVar[str] = "model"
    usage_in: ClassVar[str] = "usage"
    usage_at: ClassVar[Mapping[str, tuple[str, ...]]]
    """The places of each count of Usage in the member ``usage_in``; of several the sum."""

    def reading(
        self,
        payload: dict[str, Any],
        text: str,
        finish: str | None,
        *,
        failed: object,
        truncated: bool,
        refused: bool,
        refusal: str = "",
    ) -> Reading:
        """Return what an answer says: its text, or the words of a ``refusal`` in its place."""
        usage, counts = payload.get(self.usage_in), dict[str, int | None]()
        for name, places in self.usage_at.items():
            known = [count for p in places if (count := as_count(at(usage, p))) is not None]
            counts[name] = sum(known) if known else None
        refused = refused or bool(refusal)
        return Reading(
            outcome_of(text, failed=failed, truncated=truncated, refused=refused),
            text or refusal,
            finish,
            as_text(payload.get(self.model_at)),
            Usage(**counts),
        )

    def meaning(self, error: ServerError) -> str | None:
        """Tell filters, quotas, unknown models and what can never be sent, at any provider."""
        status, names = error.status, error.names
        # Azure's content filter, and OpenRouter's moderation.
        if status == 400 and "content_filter" in names:
            return "refusal"
        if status == 403 and "flagged_input" in error.body:
            return "refusal"
        # OpenRouter's want of credit while other requests run: it passes when they end.
        in_flight = status == 402 and "openrouter_in_flight_budget" in error.body
        if in_flight and "retry-after" in error.headers:
            return "rate_limited"
        # Gemini's quota per day has the words of one per minute, and does not pass.
        violations = [v for detail in error.details for v in as_dicts(detail.get("violations"))]
        per_day = any("PerDay" in str(violation.get("quotaId")) for violation in violations)
        spent = status == 400 and any(words in error.message for words in SPENT)
        if names & QUOTA or spent or (status == 429 and per_day):
            return "quota_exhausted"
        if status in (400, 401, 403, 404) and "model_not_found" in names:
            return "unknown_model"
        if status == 429 and error.message.startswith("Request too large"):
            return "request_too_large"
        if status == 400 and "invalid_prompt" in names:
            return "bad_prompt"
        return "not_allowed" if status == 400 and "API_KEY_INVALID" in names else None

    def delay_s(self, error: ServerError) -> float | None:
        """Read Gemini's RetryInfo among the details."""
        delays = (as_text(detail.get("retryDelay")) or "" for detail in error.details)
        return next((float(found[1]) for d in delays if (found := DURATION.fullmatch(d))), None)


class OpenAIChat(BuiltIn):
    """``POST /chat/completions``; the path can be overridden, as Azure's classic form needs."""

    parameters = plain(
        *("temperature", "top_p", "seed", "presence_penalty", "frequency_penalty"),
        *("reasoning_effort", "verbosity", "response_format"),
    )
    members = frozenset({"choices"})
    usage_at: ClassVar = {
        "input_tokens": ("prompt_tokens",),
        "cached_input_tokens": ("prompt_tokens_details.cached_tokens",),
        "output_tokens": ("completion_tokens",),
        "reasoning_tokens": ("completion_tokens_details.reasoning_tokens",),
    }

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
        content = at(payload, "choices.0.message.content")  # a list of parts at some servers
        finish = as_text(at(payload, "choices.0.finish_reason"))
        # Routers answer 200 and put the failure of a generation into the body.
        failed = payload.get("error") or at(payload, "choices.0.error") or finish == "error"
        return self.reading(
            payload,
            content if isinstance(content, str) else joined(as_dicts(content)),
            finish,
            failed=failed,
            truncated=finish == "length",
            refused=finish == "content_filter",
            refusal=as_text(at(payload, "choices.0.message.refusal")) or "",
        )


class OpenAIResponses(BuiltIn):
    """``POST /responses``, not stored at the provider."""

    parameters: ClassVar = {
        **plain("temperature", "top_p"),
        "reasoning_effort": ("reasoning", "effort"),
        "verbosity": ("text", "verbosity"),
    }
    members = frozenset({"output", "status"})
    usage_at: ClassVar = {
        "input_tokens": ("input_tokens",),
        "cached_input_tokens": ("input_tokens_details.cached_tokens",),
        "output_tokens": ("output_tokens",),
        "reasoning_tokens": ("output_tokens_details.reasoning_tokens",),
    }

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
        items = as_dicts(payload.get("output"))
        messages = [item.get("content") for item in items if item.get("type") == "message"]
        parts = [part for content in messages for part in as_dicts(content)]
        status = as_text(payload.get("status"))
        reason = as_text(at(payload, "incomplete_details.reason"))
        return self.reading(
            payload,
            joined(part for part in parts if part.get("type") == "output_text"),
            reason or status,
            failed=status == "failed" or payload.get("error"),
            truncated=reason == "max_output_tokens" or status == "incomplete",
            refused=reason == "content_filter",
            refusal=joined((part for part in parts if part.get("type") == "refusal"), "refusal"),
        )


class GeminiGenerateContent(BuiltIn):
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
    model_at, usage_in = "modelVersion", "usageMetadata"
    usage_at: ClassVar = {
        "input_tokens": ("promptTokenCount",),
        "cached_input_tokens": ("cachedContentTokenCount",),
        "output_tokens": ("candidatesTokenCount", "thoughtsTokenCount"),
        "reasoning_tokens": ("thoughtsTokenCount",),
    }

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
        finish = as_text(at(payload, "candidates.0.finishReason"))
        blocked = as_text(at(payload, "promptFeedback.blockReason"))
        return self.reading(
            payload,
            joined(part for part in parts if not part.get("thought")),
            finish or blocked,
            failed=payload.get("error"),
            truncated=finish == "MAX_TOKENS",
            refused=bool(blocked) or finish in REFUSALS,
        )


class AnthropicMessages(BuiltIn):
    """``POST /v1/messages`` with the API version as a header."""

    parameters: ClassVar = {
        **plain("temperature", "top_p", "top_k", "thinking"),
        "reasoning_effort": ("output_config", "effort"),
    }
    members = frozenset({"content", "stop_reason"})
    # The version whose sampling default is temperature 1.0; later ones reject the parameter.
    headers: ClassVar = {"anthropic-version": "2023-06-01"}
    usage_at: ClassVar = {
        # Anthropic counts cached tokens apart; here the input includes them.
        "input_tokens": (
            "input_tokens",
            "cache_read_input_tokens",
            "cache_creation_input_tokens",
        ),
        "cached_input_tokens": ("cache_read_input_tokens",),
        "output_tokens": ("output_tokens",),
        "reasoning_tokens": ("output_tokens_details.thinking_tokens",),
    }

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
        finish = as_text(payload.get("stop_reason"))
        return self.reading(
            payload,
            joined(block for block in blocks if block.get("type") == "text"),
            finish,
            failed=payload.get("type") == "error",
            truncated=finish in ("max_tokens", "model_context_window_exceeded"),
            refused=finish == "refusal",
        )
