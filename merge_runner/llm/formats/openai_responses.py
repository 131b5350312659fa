"""OpenAI Responses."""

from __future__ import annotations

from typing import Any

from merge_runner.config import ModelEntry
from merge_runner.llm.formats.base import (
    Reading,
    WireRequest,
    as_count,
    as_dict,
    as_list,
    as_text,
    outcome_of,
)
from merge_runner.llm.formats.openai_errors import OpenAIErrors
from merge_runner.records import Usage


class OpenAIResponses(OpenAIErrors):
    """``POST /responses``, not stored at the provider."""

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
            as_dict(part)
            for item in as_list(payload.get("output"))
            if as_dict(item).get("type") == "message"
            for part in as_list(as_dict(item).get("content"))
        ]
        text = "".join(
            as_text(part.get("text")) or "" for part in parts if part.get("type") == "output_text"
        )
        refusal = "".join(
            as_text(part.get("refusal")) or "" for part in parts if part.get("type") == "refusal"
        )
        status = as_text(payload.get("status"))
        reason = as_text(as_dict(payload.get("incomplete_details")).get("reason"))
        usage = as_dict(payload.get("usage"))
        return Reading(
            outcome="error"
            if status == "failed" or payload.get("error")
            else outcome_of(
                text,
                truncated=reason == "max_output_tokens" or status == "incomplete",
                refused=bool(refusal) or reason == "content_filter",
            ),
            text=text or refusal,
            finish_reason=reason or status,
            model_served=as_text(payload.get("model")),
            usage=Usage(
                input_tokens=as_count(usage.get("input_tokens")),
                cached_input_tokens=as_count(
                    as_dict(usage.get("input_tokens_details")).get("cached_tokens")
                ),
                output_tokens=as_count(usage.get("output_tokens")),
                reasoning_tokens=as_count(
                    as_dict(usage.get("output_tokens_details")).get("reasoning_tokens")
                ),
            ),
        )
