"""The emulator answers HTTP requests: within this process, as a transport of httpx, or as a server.

Requests and responses are those of httpx in both cases.
"""

from __future__ import annotations

import asyncio
import hashlib
import json
import re
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import httpx

from merge_runner.chance import draw_index
from merge_runner.config import validated
from merge_runner.emulator import Behaviour, driver
from merge_runner.emulator.formats import SERVED, Completion, ServedFormat
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
# The faults that are errors of the provider, beside a rate limit.
ERRORS = {"server_error": 500, "overloaded": 503}
PROSE = "M\n\nI would rather describe my plan in words than write a list of numbers."


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
    """Answers chat requests of every format in SERVED."""

    def __init__(self, behaviour: Behaviour | None = None) -> None:
        self.behaviour = behaviour or Behaviour()
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
                attempt = self.attempt(asked)
                fault = self.behaviour.fault(asked.where, attempt)
                try:
                    answer = self.answer(asked, attempt, fault)
                except UsageError as exc:
                    return as_error(wire, 400, str(exc))
                await asyncio.sleep(self.behaviour.latency_s)
                return await self.deliver(asked, fault, answer)
        return as_response(b"404: Not Found", 404, {"content-type": "text/plain"})

    def attempt(self, asked: Asked) -> int:
        """Return the attempt's number: the client's own count, or how often this was asked."""
        self._asked[asked.where] += 1
        is_number = re.fullmatch("[0-9]{1,6}", asked.attempt)
        return int(asked.attempt) if is_number else self._asked[asked.where]

    def answer(self, asked: Asked, attempt: int, fault: str | None) -> dict[str, Any]:
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
        if fault == "malformed":
            text = PROSE
        elif model == RANDOM_MODEL:
            text = driver.random_answer(prompt, slot)
        else:
            text = driver.answer(prompt, slot, effect)
        # A token is about four bytes.
        tokens_in, visible = len(prompt.encode()) // 4, len(text.encode()) // 4
        reasoning = 200 + draw_index(600, "reasoning", prompt)
        if typical := self.behaviour.output_tokens:
            drawn = typical // 2 + draw_index(typical, "reasoning", prompt)
            reasoning = max(0, drawn - visible)
        # Only the same attempt at the same request gets the same id: the audit takes one that
        # comes back for an answer that was given twice.
        which = f"{asked.path} {asked.where} {attempt}".encode()
        reply = hashlib.sha256(asked.raw + which).hexdigest()[:24]
        said = Completion(reply, model, text, tokens_in, visible + reasoning, reasoning)
        request = {"body_sha256": asked.body_sha256, "slot": slot and slot.as_dict()}
        return {**asked.wire.answer(said), ANSWERED_FIELD: request, SCRIPTED_FIELD: True}

    async def deliver(
        self, asked: Asked, fault: str | None, answer: dict[str, Any]
    ) -> httpx.Response:
        """Return the response with an answer, or the error that takes its place."""
        if fault == "rate_limit":
            return as_error(asked.wire, 429, "Rate limit reached.", self.behaviour.delay_s)
        if fault in ERRORS:
            return as_error(asked.wire, ERRORS[fault], "An emulated fault.")
        return as_json(answer)


def as_response(body: bytes, status: int, headers: Mapping[str, str]) -> httpx.Response:
    """Return a response that says that a mock model made it, even an error or what is no JSON."""
    # The client reads a stream as it reads any other response.
    stream = httpx.ByteStream(body)
    return httpx.Response(status, headers={**headers, SCRIPTED_HEADER: "true"}, stream=stream)


def as_json(
    body: dict[str, Any], status: int = 200, headers: Mapping[str, str] | None = None
) -> httpx.Response:
    """Return a response of JSON."""
    sent = json.dumps(body, ensure_ascii=False).encode()
    return as_response(sent, status, {"content-type": "application/json", **(headers or {})})


def as_error(wire: ServedFormat, status: int, message: str, delay_s: float = 0.0) -> httpx.Response:
    """Return an error in a provider's form."""
    body, headers = wire.error(status, message, delay_s)
    return as_json({**body, SCRIPTED_FIELD: True}, status, headers)
