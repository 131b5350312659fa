"""The emulator answers HTTP requests: within this process, as a transport of httpx, or as a server.

Requests and responses are those of httpx in both cases.
"""

from __future__ import annotations

import asyncio
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
# What anything but a chat request can raise: refused with 400.
UNREADABLE = (ValueError, TypeError, AttributeError, KeyError, IndexError, RecursionError)
# How OpenAI, Gemini and Anthropic name it.
REFUSAL = {"type": "invalid_request_error", "code": 400, "status": "INVALID_ARGUMENT"}
CREATED = 1_760_000_000
Body = dict[str, Any]


@dataclass(frozen=True, slots=True)
class ServedFormat:
    """A wire format from the server's side.

    ``path`` is a regular expression. A request has its messages in the member ``turns``, or is one
    text there, and the text of a message in ``content``; ``parameters_in`` names the member with
    its parameters, if they do not stand at the top. ``answer`` makes a body of an id, the model,
    the text and the billed tokens: those of the prompt, of the output, and those of the output that
    no reply shows.
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
    """Whole, as in the shipped recording, which the emulator makes byte for byte."""
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
class Asked:
    """A chat request as it came; ``slot`` and ``attempt`` as the client sent them.

    ``model`` is the one in the path, where it stands there.
    """

    wire: ServedFormat
    path: str
    raw: bytes
    model: str | None = None
    slot: str | None = None
    attempt: str = ""

    @property
    def body_sha256(self) -> str:
        """The hash of its body."""
        return hashlib.sha256(self.raw).hexdigest()

    @property
    def where(self) -> str:
        """The name of the request among all that may be asked."""
        return self.slot or self.body_sha256


class Emulator:
    """Answers chat requests of every format in SERVED.

    Every answer takes ``latency_s``, and has about ``output_tokens`` with its reasoning, or a few
    hundred.
    """

    def __init__(self, latency_s: float = 0.0, output_tokens: int | None = None) -> None:
        self.latency_s, self._output_tokens = latency_s, output_tokens
        self._asked: Counter[str] = Counter()

    def transport(self) -> httpx.MockTransport:
        """Return a transport that carries requests here: no server, no socket."""
        return httpx.MockTransport(self.respond)

    async def respond(self, request: httpx.Request) -> httpx.Response:
        """Answer a request of any kind."""
        path = request.url.path
        if (request.method, path) == ("GET", "/v1/models"):
            model = {"id": MODEL, "object": "model", "owned_by": "emulator"}
            return as_json({"object": "list", "data": [model]})
        for wire in SERVED:
            if request.method == "POST" and (match := re.fullmatch(wire.path, path)):
                asked = Asked(
                    wire,
                    path,
                    request.content,
                    match.groupdict().get("model"),
                    request.headers.get(SLOT_HEADER),
                    request.headers.get(ATTEMPT_HEADER, ""),
                )
                try:
                    return await self.reply(asked, self.attempt(asked))
                except UsageError as exc:
                    error = {**REFUSAL, "message": str(exc)}
                    return as_json({"type": "error", "error": error, SCRIPTED_FIELD: True}, 400)
        return as_response(b"404: Not Found", 404, {"content-type": "text/plain"})

    def attempt(self, asked: Asked) -> int:
        """Return the attempt's number: the client's own count, or how often this was asked."""
        self._asked[asked.where] += 1
        is_number = re.fullmatch("[0-9]{1,6}", asked.attempt)
        return int(asked.attempt) if is_number else self._asked[asked.where]

    async def reply(self, asked: Asked, attempt: int) -> httpx.Response:
        """Return the response to a chat request; raises UsageError where it is none."""
        answer = self.answer(asked, attempt)
        await asyncio.sleep(self.latency_s)
        return as_json(answer)

    def answer(self, asked: Asked, attempt: int) -> Body:
        """Return the body of an answer; raises UsageError where the request is none."""
        try:
            body = json.loads(asked.raw)
            slot = None if asked.slot is None else Slot(**json.loads(asked.slot))
            prompt = asked.wire.prompt(body)
            model = asked.model or str(body.get("model", MODEL))
            (prompt + model).encode()
            planted = planted_fields(asked.wire.parameters(body))
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
        if typical := self._output_tokens:
            drawn = typical // 2 + draw_index(typical, "reasoning", prompt)
            reasoning = max(0, drawn - visible)
        # Only the same attempt at the same request gets the same id: the audit takes one that
        # comes back for an answer that was given twice.
        which = f"{asked.path} {asked.where} {attempt}".encode()
        reply = hashlib.sha256(asked.raw + which).hexdigest()[:24]
        told = asked.wire.answer(reply, model, text, tokens_in, visible + reasoning, reasoning)
        request = {"body_sha256": asked.body_sha256, "slot": slot and slot.as_dict()}
        return {**told, ANSWERED_FIELD: request, SCRIPTED_FIELD: True}


def as_response(body: bytes, status: int, headers: Mapping[str, str]) -> httpx.Response:
    """Return a response that says that a mock model made it, even an error or what is no JSON."""
    # The client reads a stream as it reads any other response.
    stream = httpx.ByteStream(body)
    return httpx.Response(status, headers={**headers, SCRIPTED_HEADER: "true"}, stream=stream)


def as_json(body: Body, status: int = 200) -> httpx.Response:
    """Return a response of JSON."""
    sent = json.dumps(body, ensure_ascii=False).encode()
    return as_response(sent, status, {"content-type": "application/json"})
