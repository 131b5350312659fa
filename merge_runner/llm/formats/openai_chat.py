"""OpenAI Chat Completions, and the many servers that speak it."""

from __future__ import annotations

from typing import Any

from merge_runner.config import ModelEntry
from merge_runner.llm.formats.base import (
    Reading,
    WireRequest,
    as_dict,
    as_dicts,
    as_text,
    first_of,
    joined,
    outcome_of,
    plain,
)
from merge_runner.llm.formats.openai import OpenAI, usage_of


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
        """One user message; the cap covers reasoning and visible tokens."""
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
        text = _content(message.get("content"))
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
            usage=usage_of(payload, "prompt", "completion"),
        )


def _content(content: object) -> str:
    """The text of a message, which some servers send as a list of parts."""
    if isinstance(content, str):
        return content
    return joined(as_dicts(content))
