"""The wire formats as a server speaks them: prompts in, answers and errors out."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

CREATED = 1_760_000_000
Body = dict[str, Any]
# What OpenAI, Gemini and Anthropic call an error of a status.
ERROR_NAMES = {
    400: ("invalid_request_error", "INVALID_ARGUMENT", "invalid_request_error"),
    404: ("not_found", "NOT_FOUND", "not_found_error"),
    408: ("timeout", "DEADLINE_EXCEEDED", "timeout_error"),
    409: ("conflict", "ABORTED", "conflict_error"),
    429: ("rate_limit_exceeded", "RESOURCE_EXHAUSTED", "rate_limit_error"),
    500: ("server_error", "INTERNAL", "api_error"),
    503: ("server_is_overloaded", "UNAVAILABLE", "overloaded_error"),
}


@dataclass(frozen=True, slots=True)
class Completion:
    """An answer of the model; ``reply`` becomes part of its id.

    ``output`` are the billed output tokens, ``reasoning`` those of them that no reply shows.
    """

    reply: str
    model: str
    text: str
    tokens_in: int
    output: int
    reasoning: int


@dataclass(frozen=True, slots=True)
class ServedFormat:
    """A wire format from the server's side.

    ``path`` is a regular expression. A request has its messages in the member ``turns``, or is one
    text there, and the text of a message in ``content``; ``parameters_in`` names the member with
    its parameters, if they do not stand at the top. ``error`` makes a body and its headers from a
    status, a message and a delay in s.
    """

    path: str
    turns: str
    content: str
    answer: Callable[[Completion], Body]
    error: Callable[[int, str, float], tuple[Body, dict[str, str]]]
    parameters_in: str | None = None

    def prompt(self, body: Body) -> str:
        """Return the text of the last message."""
        turns = body.get(self.turns) or ""
        text = turns[-1].get(self.content, "") if isinstance(turns, list) else turns
        return text if isinstance(text, str) else "".join(str(p.get("text", "")) for p in text)

    def parameters(self, body: Body) -> Body:
        """Return the parameters of a request."""
        return dict(body.get(self.parameters_in) or {}) if self.parameters_in else body


def _chat(said: Completion) -> Body:
    """Whole, as in the shipped recording, which the emulator makes byte for byte."""
    message: Body = {"role": "assistant", "content": said.text, "refusal": None, "annotations": []}
    return {
        "id": f"chatcmpl-{said.reply}",
        "object": "chat.completion",
        "created": CREATED,
        "model": said.model,
        "choices": [{"index": 0, "message": message, "logprobs": None, "finish_reason": "stop"}],
        "usage": {
            "prompt_tokens": said.tokens_in,
            "completion_tokens": said.output,
            "total_tokens": said.tokens_in + said.output,
            "prompt_tokens_details": {"cached_tokens": 0, "audio_tokens": 0},
            "completion_tokens_details": {"reasoning_tokens": said.reasoning, "audio_tokens": 0},
        },
        "service_tier": "default",
        "system_fingerprint": None,
    }


def _response(said: Completion) -> Body:
    content = [{"type": "output_text", "text": said.text, "annotations": []}]
    message: Body = {
        "type": "message",
        "role": "assistant",
        "status": "completed",
        "content": content,
    }
    return {
        "id": f"resp_{said.reply}",
        "object": "response",
        "created_at": CREATED,
        "status": "completed",
        "model": said.model,
        "output": [{"type": "reasoning", "summary": []}, message],
        "usage": {
            "input_tokens": said.tokens_in,
            "output_tokens": said.output,
            "output_tokens_details": {"reasoning_tokens": said.reasoning},
            "total_tokens": said.tokens_in + said.output,
        },
    }


def _content(said: Completion) -> Body:
    content = {"role": "model", "parts": [{"text": said.text}]}
    return {
        "candidates": [{"content": content, "finishReason": "STOP", "index": 0}],
        "usageMetadata": {
            "promptTokenCount": said.tokens_in,
            "candidatesTokenCount": said.output - said.reasoning,
            "thoughtsTokenCount": said.reasoning,
            "totalTokenCount": said.tokens_in + said.output,
        },
        "modelVersion": said.model,
        "responseId": said.reply,
    }


def _message(said: Completion) -> Body:
    return {
        "id": f"msg_{said.reply}",
        "type": "message",
        "role": "assistant",
        "model": said.model,
        "content": [{"type": "text", "text": said.text}],
        "stop_reason": "end_turn",
        "usage": {
            "input_tokens": said.tokens_in,
            "output_tokens": said.output,
            "output_tokens_details": {"thinking_tokens": said.reasoning},
        },
    }


def _openai_error(status: int, message: str, delay_s: float) -> tuple[Body, dict[str, str]]:
    """Tell the delay in the message alone."""
    name = ERROR_NAMES[status][0]
    if delay_s:
        message = f"{message} Please try again in {delay_s * 1000:.0f}ms."
    error = {"message": message, "type": name, "param": None, "code": name}
    return {"error": error}, {"x-ratelimit-remaining-requests": "0"} if delay_s else {}


def _gemini_error(status: int, message: str, delay_s: float) -> tuple[Body, dict[str, str]]:
    """Tell the delay in the message and in the details."""
    details: list[Body] = []
    if delay_s:
        message = f"{message} Please retry in {delay_s:.9f}s."
        kind = "type.googleapis.com/google.rpc.RetryInfo"
        details = [{"@type": kind, "retryDelay": f"{delay_s:.9f}s"}]
    name = ERROR_NAMES[status][1]
    error = {"code": status, "message": message, "status": name, "details": details}
    return {"error": error}, {}


def _anthropic_error(status: int, message: str, delay_s: float) -> tuple[Body, dict[str, str]]:
    """Tell the delay in a header."""
    error = {"type": ERROR_NAMES[status][2], "message": message}
    body = {"type": "error", "error": error, "request_id": "req_emulated"}
    return body, {"retry-after": str(delay_s)} if delay_s else {}


CHAT = ServedFormat("/v1/chat/completions", "messages", "content", _chat, _openai_error)
RESPONSES = ServedFormat("/v1/responses", "input", "content", _response, _openai_error)
GEMINI = ServedFormat(
    r"/v1\w*/models/(?P<model>[^/]+?):generateContent",
    "contents",
    "parts",
    _content,
    _gemini_error,
    parameters_in="generationConfig",
)
MESSAGES = ServedFormat("/v1/messages", "messages", "content", _message, _anthropic_error)
SERVED = (CHAT, RESPONSES, GEMINI, MESSAGES)
