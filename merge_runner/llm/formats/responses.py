"""Responses format of OpenAI."""

from __future__ import annotations

from typing import Any, ClassVar

from merge_runner.llm.formats.wire import (
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
        final = [item for item in messages if item.get("phase") != "commentary"]
        comments = [item for item in messages if item.get("phase") == "commentary"] if final else []
        parts = [part for item in final or messages for part in as_dicts(item.get("content"))]
        text = joined(part for part in parts if part.get("type") == "output_text")
        reasoned = [item for item in items if item.get("type") == "reasoning"] + comments
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
