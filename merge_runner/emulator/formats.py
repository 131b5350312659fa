"""The wire formats as a server speaks them: prompts in, answers and errors out."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any, ClassVar

from merge_runner.chance import draw_index

CREATED = 1_760_000_000
REFUSAL = "I cannot help with that."
Turn = Any
"""A message as a client sent it: a text, or parts with texts."""
Envelope = tuple[dict[str, Any], dict[str, str]]
"""A body, and the headers that come with it."""


@dataclass(frozen=True, slots=True)
class Said:
    """An answer of the model to a prompt; ``reply`` becomes part of its id.

    Its token counts are about a quarter of the bytes, and as many for the reasoning as bring its
    output to about ``typical_output``, or a few hundred.
    """

    reply: str
    model: str
    prompt: str
    text: str
    refused: bool
    typical_output: int | None = None

    @property
    def tokens_in(self) -> int:
        """Input tokens."""
        return len(self.prompt.encode()) // 4

    @property
    def visible(self) -> int:
        """Output tokens of the text."""
        return len(self.text.encode()) // 4

    @property
    def reasoning(self) -> int:
        """Output tokens of the reasoning, which no reply shows."""
        if self.typical_output is None:
            return 200 + draw_index(600, "reasoning", self.prompt)
        drawn = self.typical_output // 2 + draw_index(self.typical_output, "reasoning", self.prompt)
        return max(0, drawn - self.visible)

    @property
    def output(self) -> int:
        """Billed output tokens."""
        return self.visible + self.reasoning


class ServedFormat(ABC):
    """A wire format from the server's side."""

    path: ClassVar[str]
    """Where requests go, as a regular expression."""

    error_names: ClassVar[dict[int, str]]
    """What the provider calls an error, by its status."""

    def last_turn(self, body: dict[str, Any]) -> Turn:
        """The user's last message in a request."""
        return (body.get("messages") or [{}])[-1].get("content", "")

    def parameters(self, body: dict[str, Any]) -> dict[str, Any]:
        """Where the parameters of a request stand."""
        return body

    @abstractmethod
    def answer(self, said: Said) -> dict[str, Any]:
        """The body of a reply."""

    @abstractmethod
    def error(self, status: int, message: str, delay_s: float = 0.0) -> Envelope:
        """An error, which tells a delay in the provider's way."""

    def prompt(self, body: dict[str, Any]) -> str:
        """The text of the last user message."""
        turn = self.last_turn(body)
        if isinstance(turn, str):
            return turn
        return "".join(str(part.get("text", "")) for part in turn)


class _OpenAI(ServedFormat):
    """What both formats of OpenAI share: the errors."""

    error_names: ClassVar = {
        400: "invalid_request_error",
        404: "not_found",
        408: "timeout",
        409: "conflict",
        429: "rate_limit_exceeded",
        500: "server_error",
        503: "server_is_overloaded",
    }

    def error(self, status: int, message: str, delay_s: float = 0.0) -> Envelope:
        """The delay is in the message alone."""
        kind = self.error_names[status]
        if delay_s:
            message = f"{message} Please try again in {delay_s * 1000:.0f}ms."
        error = {"message": message, "type": kind, "param": None, "code": kind}
        return {"error": error}, {"x-ratelimit-remaining-requests": "0"} if delay_s else {}


class _Chat(_OpenAI):
    path = "/v1/chat/completions"

    def answer(self, said: Said) -> dict[str, Any]:
        refused = said.refused
        return {
            "id": f"chatcmpl-{said.reply}",
            "object": "chat.completion",
            "created": CREATED,
            "model": said.model,
            "choices": [
                {
                    "index": 0,
                    "message": {
                        "role": "assistant",
                        "content": None if refused else said.text,
                        "refusal": REFUSAL if refused else None,
                        "annotations": [],
                    },
                    "logprobs": None,
                    "finish_reason": "stop",
                }
            ],
            "usage": {
                "prompt_tokens": said.tokens_in,
                "completion_tokens": said.output,
                "total_tokens": said.tokens_in + said.output,
                "prompt_tokens_details": {"cached_tokens": 0, "audio_tokens": 0},
                "completion_tokens_details": {
                    "reasoning_tokens": said.reasoning,
                    "audio_tokens": 0,
                },
            },
            "service_tier": "default",
            "system_fingerprint": None,
        }


class _Responses(_OpenAI):
    path = "/v1/responses"

    def last_turn(self, body: dict[str, Any]) -> Turn:
        turn = body.get("input", "")
        return turn[-1].get("content", "") if isinstance(turn, list) and turn else turn

    def answer(self, said: Said) -> dict[str, Any]:
        part = (
            {"type": "refusal", "refusal": REFUSAL}
            if said.refused
            else {"type": "output_text", "text": said.text, "annotations": []}
        )
        return {
            "id": f"resp_{said.reply}",
            "object": "response",
            "created_at": CREATED,
            "status": "completed",
            "model": said.model,
            "error": None,
            "incomplete_details": None,
            "instructions": None,
            "metadata": {},
            "parallel_tool_calls": True,
            "tool_choice": "auto",
            "tools": [],
            "output": [
                {"type": "reasoning", "id": f"rs_{said.reply}", "summary": []},
                {
                    "type": "message",
                    "id": f"msg_{said.reply}",
                    "role": "assistant",
                    "status": "completed",
                    "content": [part],
                },
            ],
            "usage": {
                "input_tokens": said.tokens_in,
                "input_tokens_details": {"cached_tokens": 0},
                "output_tokens": said.output,
                "output_tokens_details": {"reasoning_tokens": said.reasoning},
                "total_tokens": said.tokens_in + said.output,
            },
            "temperature": 1.0,
            "top_p": 1.0,
        }


class _Gemini(ServedFormat):
    path = r"/(?P<version>v1\w*)/models/(?P<model>[^/]+?):generateContent"
    error_names: ClassVar = {
        400: "INVALID_ARGUMENT",
        404: "NOT_FOUND",
        408: "DEADLINE_EXCEEDED",
        409: "ABORTED",
        429: "RESOURCE_EXHAUSTED",
        500: "INTERNAL",
        503: "UNAVAILABLE",
    }

    def last_turn(self, body: dict[str, Any]) -> Turn:
        return (body.get("contents") or [{}])[-1].get("parts", [])

    def parameters(self, body: dict[str, Any]) -> dict[str, Any]:
        return dict(body.get("generationConfig") or {})

    def answer(self, said: Said) -> dict[str, Any]:
        content: dict[str, Any] = {"role": "model"}
        if said.text and not said.refused:
            content["parts"] = [{"text": said.text}]
        finish = "SAFETY" if said.refused else "STOP"
        return {
            "candidates": [{"content": content, "finishReason": finish, "index": 0}],
            "usageMetadata": {
                "promptTokenCount": said.tokens_in,
                "candidatesTokenCount": said.visible,
                "thoughtsTokenCount": said.reasoning,
                "totalTokenCount": said.tokens_in + said.output,
            },
            "modelVersion": said.model,
            "responseId": said.reply,
        }

    def error(self, status: int, message: str, delay_s: float = 0.0) -> Envelope:
        """The delay is in the message and in the details; a quota per minute passes by waiting."""
        details = []
        if delay_s:
            message = f"{message} Please retry in {delay_s:.9f}s."
            details = [
                {
                    "@type": "type.googleapis.com/google.rpc.QuotaFailure",
                    "violations": [
                        {"quotaId": "GenerateRequestsPerMinutePerProjectPerModel-FreeTier"}
                    ],
                },
                {
                    "@type": "type.googleapis.com/google.rpc.RetryInfo",
                    "retryDelay": f"{delay_s:.9f}s",
                },
            ]
        name = self.error_names[status]
        error = {"code": status, "message": message, "status": name, "details": details}
        return {"error": error}, {}


class _Anthropic(ServedFormat):
    path = "/v1/messages"
    error_names: ClassVar = {
        400: "invalid_request_error",
        404: "not_found_error",
        408: "timeout_error",
        409: "conflict_error",
        429: "rate_limit_error",
        500: "api_error",
        503: "overloaded_error",
    }

    def answer(self, said: Said) -> dict[str, Any]:
        return {
            "id": f"msg_{said.reply}",
            "type": "message",
            "role": "assistant",
            "model": said.model,
            "content": [{"type": "text", "text": said.text}]
            if said.text and not said.refused
            else [],
            "stop_reason": "refusal" if said.refused else "end_turn",
            "stop_sequence": None,
            "usage": {
                "input_tokens": said.tokens_in,
                "cache_creation_input_tokens": 0,
                "cache_read_input_tokens": 0,
                "output_tokens": said.output,
                "output_tokens_details": {"thinking_tokens": said.reasoning},
                "service_tier": "standard",
            },
        }

    def error(self, status: int, message: str, delay_s: float = 0.0) -> Envelope:
        """The delay is in a header."""
        body = {
            "type": "error",
            "error": {"type": self.error_names[status], "message": message},
            "request_id": "req_emulated",
        }
        return body, {"retry-after": str(delay_s)} if delay_s else {}


CHAT, RESPONSES, GEMINI, MESSAGES = _Chat(), _Responses(), _Gemini(), _Anthropic()
SERVED = (CHAT, RESPONSES, GEMINI, MESSAGES)
