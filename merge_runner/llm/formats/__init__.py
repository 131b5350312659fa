"""The wire formats: how a prompt becomes a request body, and a reply's body an answer."""

from __future__ import annotations

from merge_runner.llm.formats.base import WireFormat
from merge_runner.llm.formats.builtin import (
    AnthropicMessages,
    GeminiGenerateContent,
    OpenAIChat,
    OpenAIResponses,
)
from merge_runner.registry import Registry

FORMATS: Registry[WireFormat] = Registry("wire format")
# Gateways pass on the errors of these providers, whatever format they speak themselves. What an
# added format knows is its own alone: it must not change how the replies of another are read.
PASSED_ON = (FORMATS.register("openai-chat", OpenAIChat()),)
FORMATS.register("openai-responses", OpenAIResponses())
FORMATS.register("gemini", GeminiGenerateContent())
FORMATS.register("anthropic", AnthropicMessages())
