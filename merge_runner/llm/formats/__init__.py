"""Wire formats: make request bodies of prompts, and read answers from reply bodies.

OpenAI has two, which many servers speak; Gemini and Anthropic have one each. A package can
add others.
"""

from __future__ import annotations

from typing import Any

from merge_runner.llm.formats.others import (
    AnthropicMessages,
    GeminiGenerateContent,
    OpenAIResponses,
)
from merge_runner.llm.formats.server_error import ServerError
from merge_runner.llm.formats.wire import (
    OpenAIChat,
    Reading,
    WireFormat,
    WireRequest,
    as_count,
    as_text,
    outcome_of,
    read_reply,
)
from merge_runner.registry import Registry

__all__ = [
    "FORMATS",
    "Reading",
    "ServerError",
    "WireFormat",
    "WireRequest",
    "as_count",
    "as_text",
    "outcome_of",
    "reasoning_of",
]

FORMATS: Registry[WireFormat] = Registry("wire format")
for _name, _format in {
    "openai-chat": OpenAIChat(),
    "openai-responses": OpenAIResponses(),
    "gemini": GeminiGenerateContent(),
    "anthropic": AnthropicMessages(),
}.items():
    FORMATS.register(_name, _format)


def reasoning_of(payload: dict[str, Any]) -> str:
    """Return the reasoning in a body of any known format."""
    readings = (read_reply(w, payload) for w in FORMATS.values() if w.members & payload.keys())
    return next((reading.reasoning for reading in readings if reading.reasoning), "")
