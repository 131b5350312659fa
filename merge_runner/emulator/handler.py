"""The emulator as a handler of HTTP requests: a transport of httpx, or the core of its server.

It takes and returns objects of httpx in both cases.
"""

from __future__ import annotations

import hashlib
import json
import re
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import httpx

from merge_runner.chance import draw_index
from merge_runner.config import validated
from merge_runner.emulator import driver
from merge_runner.errors import UsageError
from merge_runner.planted_effect import PlantedEffect, planted_fields
from merge_runner.records import (
    ANSWERED_FIELD,
    ATTEMPT_HEADER,
    SCRIPTED_FIELD,
    SCRIPTED_HEADER,
    SLOT_HEADER,
    Slot,
)

MODEL, RANDOM_MODEL = "scripted-driver", "random-driver"
# A body that is no chat request can raise these: it is refused with 400.
UNREADABLE = (ValueError, TypeError, AttributeError, KeyError, IndexError, RecursionError)
# The names of a refusal by OpenAI, Gemini and Anthropic.
REFUSAL = {"type": "invalid_request_error", "code": 400, "status": "INVALID_ARGUMENT"}
CREATED = 1_760_000_000
Body = dict[str, Any]


@dataclass(frozen=True, slots=True)
class ServedFormat:
    """Wire format on the server's side.

    ``path`` is a regular expression. The member ``turns`` of a request has its messages, or one
    text; ``content`` of a message has its text; ``parameters_in`` names the member with the
    parameters (None: the top level). ``answer`` makes a response's body of an id, the model, the
    text and the billed tokens: of the prompt, of the output, and of reasoning within the output.
    """

    path: str
    turns: str
    content: str
    answer: Callable[[str, str, str, int, int, int], Body]
    parameters_in: str | None = None

    def prompt(self, body: Body) -> str:
        """Return the text of the last message."""
        turns = body.get(self.turns) or ""
        text = turns[-1].get(self.content, "") if isinstance(turns, list) else turns
        return text if isinstance(text, str) else "".join(str(p.get("text", "")) for p in text)

    def parameters(self, body: Body) -> Body:
        """Return the parameters of a request."""
        return dict(body.get(self.parameters_in) or {}) if self.parameters_in else body


def _chat(reply: str, model: str, text: str, tokens: int, output: int, reasoning: int) -> Body:
    """Return every member of a response, so that the shipped recording stays byte for byte."""
    message: Body = {"role": "assistant", "content": text, "refusal": None, "annotations": []}
    return {
        "id": f"chatcmpl-{reply}",
        "object": "chat.completion",
        "created": CREATED,
        "model": model,
        "choices": [{"index": 0, "message": message, "logprobs": None, "finish_reason": "stop"}],
        "usage": {
            "prompt_tokens": tokens,
            "completion_tokens": output,
            "total_tokens": tokens + output,
            "prompt_tokens_details": {"cached_tokens": 0, "audio_tokens": 0},
            "completion_tokens_details": {"reasoning_tokens": reasoning, "audio_tokens": 0},
        },
        "service_tier": "default",
        "system_fingerprint": None,
    }


def _response(reply: str, model: str, text: str, tokens: int, output: int, reasoning: int) -> Body:
    content = [{"type": "output_text", "text": text, "annotations": []}]
    message: Body = {
        "type": "message",
        "role": "assistant",
        "status": "completed",
        "content": content,
    }
    return {
        "id": f"resp_{reply}",
        "object": "response",
        "created_at": CREATED,
        "status": "completed",
        "model": model,
        "output": [{"type": "reasoning", "summary": []}, message],
        "usage": {
            "input_tokens": tokens,
            "output_tokens": output,
            "output_tokens_details": {"reasoning_tokens": reasoning},
            "total_tokens": tokens + output,
        },
    }


def _content(reply: str, model: str, text: str, tokens: int, output: int, reasoning: int) -> Body:
    content = {"role": "model", "parts": [{"text": text}]}
    return {
        "candidates": [{"content": content, "finishReason": "STOP", "index": 0}],
        "usageMetadata": {
            "promptTokenCount": tokens,
            "candidatesTokenCount": output - reasoning,
            "thoughtsTokenCount": reasoning,
            "totalTokenCount": tokens + output,
        },
        "modelVersion": model,
        "responseId": reply,
    }


def _message(reply: str, model: str, text: str, tokens: int, output: int, reasoning: int) -> Body:
    return {
        "id": f"msg_{reply}",
        "type": "message",
        "role": "assistant",
        "model": model,
        "content": [{"type": "text", "text": text}],
        "stop_reason": "end_turn",
        "usage": {
            "input_tokens": tokens,
            "output_tokens": output,
            "output_tokens_details": {"thinking_tokens": reasoning},
        },
    }


CHAT = ServedFormat("/v1/chat/completions", "messages", "content", _chat)
RESPONSES = ServedFormat("/v1/responses", "input", "content", _response)
GEMINI = ServedFormat(
    r"/v1\w*/models/(?P<model>[^/]+?):generateContent",
    "contents",
    "parts",
    _content,
    parameters_in="generationConfig",
)
MESSAGES = ServedFormat("/v1/messages", "messages", "content", _message)
SERVED = (CHAT, RESPONSES, GEMINI, MESSAGES)


@dataclass(frozen=True, slots=True)
class ReceivedRequest:
    """A chat request; ``slot`` and ``attempt`` are headers, ``model`` is the one in the path."""

    wire: ServedFormat
    path: str
    raw: bytes
    model: str | None = None
    slot: str | None = None
    attempt: str = ""

    @property
    def body_sha256(self) -> str:
        """SHA-256 of the body."""
        return hashlib.sha256(self.raw).hexdigest()

    @property
    def where(self) -> str:
        """Identity of the request: its slot, or the hash of its body."""
        return self.slot or self.body_sha256


class Emulator:
    """Answers chat requests of every format in SERVED."""

    def __init__(self) -> None:
        self._attempts: Counter[str] = Counter()

    def transport(self) -> httpx.MockTransport:
        """Return a transport that passes requests to this emulator, without a socket."""
        return httpx.MockTransport(self.respond)

    async def respond(self, request: httpx.Request) -> httpx.Response:
        """Return the response to any request."""
        path = request.url.path
        if (request.method, path) == ("GET", "/v1/models"):
            model = {"id": MODEL, "object": "model", "owned_by": "emulator"}
            return as_json({"object": "list", "data": [model]})
        for wire in SERVED:
            if request.method == "POST" and (match := re.fullmatch(wire.path, path)):
                received = ReceivedRequest(
                    wire,
                    path,
                    request.content,
                    match.groupdict().get("model"),
                    request.headers.get(SLOT_HEADER),
                    request.headers.get(ATTEMPT_HEADER, ""),
                )
                try:
                    return await self.reply(received, self.attempt(received))
                except UsageError as exc:
                    error = {**REFUSAL, "message": str(exc)}
                    return as_json({"type": "error", "error": error, SCRIPTED_FIELD: True}, 400)
        return as_response(b"404: Not Found", 404, {"content-type": "text/plain"})

    def attempt(self, received: ReceivedRequest) -> int:
        """Return the number of the attempt: the client's, or the count of equal requests."""
        self._attempts[received.where] += 1
        is_number = re.fullmatch("[0-9]{1,6}", received.attempt)
        return int(received.attempt) if is_number else self._attempts[received.where]

    async def reply(self, received: ReceivedRequest, attempt: int) -> httpx.Response:
        """Return the response to a chat request; raise UsageError if it is none."""
        return as_json(self.answer(received, attempt))

    def answer(self, received: ReceivedRequest, attempt: int) -> Body:
        """Return the body of that response; raise UsageError if the request is no chat request."""
        try:
            body = json.loads(received.raw)
            slot = None if received.slot is None else Slot(**json.loads(received.slot))
            prompt = received.wire.prompt(body)
            model = received.model or str(body.get("model", MODEL))
            (prompt + model).encode()
            planted = planted_fields(received.wire.parameters(body))
        except UNREADABLE as exc:
            raise UsageError("The body is not valid.") from exc
        effect = validated(PlantedEffect, planted, "the emulator") if planted else None
        if model == RANDOM_MODEL:
            text = driver.random_answer(prompt, slot)
        else:
            text = driver.answer(prompt, slot, effect)
        # A token is about four bytes.
        tokens_in, visible = len(prompt.encode()) // 4, len(text.encode()) // 4
        reasoning = 200 + draw_index(600, "reasoning", prompt)
        # Another attempt gets another id: the audit reports an id that occurs twice.
        identity = f"{received.path} {received.where} {attempt}".encode()
        reply = hashlib.sha256(received.raw + identity).hexdigest()[:24]
        answered = received.wire.answer(
            reply, model, text, tokens_in, visible + reasoning, reasoning
        )
        request = {"body_sha256": received.body_sha256, "slot": slot and slot.as_dict()}
        return {**answered, ANSWERED_FIELD: request, SCRIPTED_FIELD: True}


def as_response(body: bytes, status: int, headers: Mapping[str, str]) -> httpx.Response:
    """Return a response with the header that names a mock model as its source."""
    # The client reads its responses as streams.
    stream = httpx.ByteStream(body)
    return httpx.Response(status, headers={**headers, SCRIPTED_HEADER: "true"}, stream=stream)


def as_json(body: Body, status: int = 200) -> httpx.Response:
    """Return a JSON response."""
    sent = json.dumps(body, ensure_ascii=False).encode()
    return as_response(sent, status, {"content-type": "application/json"})
