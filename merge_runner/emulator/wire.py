"""The four wire formats seen from the server: prompts in, answers and errors out."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

from merge_runner.emulator.chance import draw_index
from merge_runner.records import SCRIPTED_FIELD

CREATED = 1_760_000_000
OPENAI_ERRORS = {
    400: "invalid_request_error",
    408: "timeout",
    409: "conflict",
    429: "rate_limit_exceeded",
    500: "server_error",
    503: "server_is_overloaded",
}
# How each provider names an error of a status.
ERROR_NAMES: dict[str, dict[int, str]] = {
    "openai-chat": OPENAI_ERRORS,
    "openai-responses": OPENAI_ERRORS,
    "gemini": {
        400: "INVALID_ARGUMENT",
        408: "DEADLINE_EXCEEDED",
        409: "ABORTED",
        429: "RESOURCE_EXHAUSTED",
        500: "INTERNAL",
        503: "UNAVAILABLE",
    },
    "anthropic": {
        400: "invalid_request_error",
        408: "timeout_error",
        409: "conflict_error",
        429: "rate_limit_error",
        500: "api_error",
        503: "overloaded_error",
    },
}
Ending = Literal["stop", "refused", "empty"]


@dataclass(frozen=True, slots=True)
class Answer:
    """What is sent back: a JSON body with its status and headers."""

    body: Any
    status: int = 200
    headers: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class _Said:
    """What the model said, with its token counts; ``reply`` identifies this reply."""

    reply: str
    model: str
    text: str
    ending: Ending
    tokens_in: int
    visible: int
    reasoning: int

    @property
    def output(self) -> int:
        """Billed output tokens."""
        return self.visible + self.reasoning


def prompt_of(wire: str, body: dict[str, Any]) -> str:
    """The text of the last user message."""
    if wire == "openai-responses":
        content: Any = body.get("input", "")
        if isinstance(content, list) and content:
            content = content[-1].get("content", "")
    elif wire == "gemini":
        content = (body.get("contents") or [{}])[-1].get("parts", [])
    else:
        content = (body.get("messages") or [{}])[-1].get("content", "")
    if isinstance(content, str):
        return content
    return "".join(str(part.get("text", "")) for part in content)


def answer_in(wire: str, reply: str, model: str, prompt: str, text: str, ending: Ending) -> Answer:
    """An answer of a model; token counts are about a quarter of the bytes.

    ``reply`` becomes part of its id.
    """
    text = "" if ending == "empty" else text
    tokens_in = len(prompt.encode()) // 4
    visible = len(text.encode()) // 4
    reasoning = 200 + draw_index(600, "reasoning", prompt)
    build = {
        "openai-chat": _chat,
        "openai-responses": _responses,
        "gemini": _gemini,
        "anthropic": _anthropic,
    }[wire]
    return Answer(build(_Said(reply, model, text, ending, tokens_in, visible, reasoning)))


def error_in(wire: str, status: int, message: str, delay_s: float = 0.0) -> Answer:
    """An error in a provider's envelope; a rate limit tells the delay in the provider's way."""
    kind = ERROR_NAMES[wire][status]
    if wire == "gemini":
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
        error = {"code": status, "message": message, "status": kind, "details": details}
        return Answer({"error": error}, status)
    if wire == "anthropic":
        body = {
            "type": "error",
            "error": {"type": kind, "message": message},
            "request_id": "req_emulated",
        }
        return Answer(body, status, {"retry-after": str(delay_s)} if delay_s else {})
    if delay_s:
        message = f"{message} Please try again in {delay_s * 1000:.0f}ms."
    error = {"message": message, "type": kind, "param": None, "code": kind}
    headers = {"x-ratelimit-remaining-requests": "0"} if delay_s else {}
    return Answer({"error": error}, status, headers)


def _chat(said: _Said) -> dict[str, Any]:
    refused = said.ending == "refused"
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
                    "refusal": "I cannot help with that." if refused else None,
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
            "completion_tokens_details": {"reasoning_tokens": said.reasoning, "audio_tokens": 0},
        },
        "service_tier": "default",
        "system_fingerprint": None,
    }


def _responses(said: _Said) -> dict[str, Any]:
    part = (
        {"type": "refusal", "refusal": "I cannot help with that."}
        if said.ending == "refused"
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


def _gemini(said: _Said) -> dict[str, Any]:
    content: dict[str, Any] = {"role": "model"}
    if said.text and said.ending == "stop":
        content["parts"] = [{"text": said.text}]
    finish = "SAFETY" if said.ending == "refused" else "STOP"
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


def _anthropic(said: _Said) -> dict[str, Any]:
    return {
        "id": f"msg_{said.reply}",
        "type": "message",
        "role": "assistant",
        "model": said.model,
        "content": [{"type": "text", "text": said.text}]
        if said.text and said.ending == "stop"
        else [],
        "stop_reason": "refusal" if said.ending == "refused" else "end_turn",
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


def dumps(body: Any) -> bytes:  # noqa: ANN401 # any JSON that a provider sends
    """A body as it is sent, with the field that says that no model made it."""
    marked = [_marked(part) for part in body] if isinstance(body, list) else _marked(body)
    return json.dumps(marked, ensure_ascii=False).encode()


def _marked(part: dict[str, Any]) -> dict[str, Any]:
    return {**part, SCRIPTED_FIELD: True}
