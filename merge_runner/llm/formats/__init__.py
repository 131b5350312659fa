"""The wire formats: how a prompt becomes a request body, and a reply's body an answer."""

from __future__ import annotations

from merge_runner.config import Format
from merge_runner.llm.formats.anthropic import AnthropicMessages
from merge_runner.llm.formats.base import WireFormat
from merge_runner.llm.formats.gemini import GeminiGenerateContent
from merge_runner.llm.formats.openai_chat import OpenAIChat
from merge_runner.llm.formats.openai_responses import OpenAIResponses

FORMATS: dict[Format, WireFormat] = {
    "openai-chat": OpenAIChat(),
    "openai-responses": OpenAIResponses(),
    "gemini": GeminiGenerateContent(),
    "anthropic": AnthropicMessages(),
}
