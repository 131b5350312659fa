"""OpenAI Responses."""

from __future__ import annotations

from typing import Any

from merge_runner.config import ModelEntry
from merge_runner.llm.formats.base import (
    Reading,
    WireRequest,
    as_dict,
    as_dicts,
    as_text,
    joined,
    outcome_of,
    plain,
)
from merge_runner.llm.formats.openai import OpenAI, usage_of


class OpenAIResponses(OpenAI):
    """``POST /responses``, not stored at the provider."""

    parameters = {  # noqa: RUF012 # never changed
        **plain("temperature", "top_p"),
        "reasoning_effort": ("reasoning", "effort"),
        "verbosity": ("text", "verbosity"),
    }
    members = frozenset({"output", "status"})

    def request(self, entry: ModelEntry, prompt: str) -> WireRequest:
        """The prompt as the whole input; the cap covers reasoning and visible tokens."""
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
            usage=usage_of(payload, "input", "output"),
        )
