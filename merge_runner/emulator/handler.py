"""The emulator: answers HTTP requests in this process, and as a transport of httpx."""

from __future__ import annotations

import asyncio
import re
from collections.abc import Awaitable, Callable, Mapping
from dataclasses import replace
from functools import partial

import httpx

from merge_runner.emulator.batches import AnthropicMode, Batches, GeminiMode, OpenAIMode
from merge_runner.emulator.exchange import BrokenOff, Request, Response, as_error, as_json
from merge_runner.emulator.faults import STATUS_FAULTS, FaultPlan
from merge_runner.emulator.formats import SERVED, ServedFormat
from merge_runner.emulator.replies import MODELS, Asked, Replies, dumps
from merge_runner.errors import UsageError
from merge_runner.records import ATTEMPT_HEADER, SCRIPTED_HEADER, SLOT_HEADER

ID_HEADER = "x-request-id"
Handler = Callable[[Request], Response | Awaitable[Response]]


class Emulator:
    """Answers chat requests of every format in SERVED; ``faults`` decides what goes wrong."""

    def __init__(self, faults: FaultPlan | None = None) -> None:
        self._faults = faults or FaultPlan()
        self._replies = Replies(self._faults)
        self._batches = Batches(self._replies)
        routes: list[tuple[str, str, Handler]] = [
            *(("POST", wire.path, partial(self._serve, wire)) for wire in SERVED),
            ("GET", "/v1/models", self._models),
            *OpenAIMode(self._batches).routes(),
            *AnthropicMode(self._batches).routes(),
            *GeminiMode(self._batches).routes(),
            ("GET", "/emulator/answered", self._answered),
        ]
        self._routes = [(method, re.compile(path), handler) for method, path, handler in routes]

    async def respond(self, request: Request) -> Response:
        """Answer a request; raises BrokenOff."""
        for method, pattern, handler in self._routes:
            if method == request.method and (named := pattern.fullmatch(request.path)):
                response = handler(replace(request, named=named.groupdict()))
                return response if isinstance(response, Response) else await response
        return Response(b"404: Not Found", 404, {"content-type": "text/plain"})

    def _models(self, request: Request) -> Response:
        listed = [{"id": model, "object": "model", "owned_by": "emulator"} for model in MODELS]
        return as_json({"object": "list", "data": listed})

    def _answered(self, request: Request) -> Response:
        """How often each request was answered, also in batches that nobody has fetched yet."""
        self._batches.settle()
        return Response(dumps(self._replies.count()))

    async def _serve(self, wire: ServedFormat, request: Request) -> Response:
        asked = Asked(
            wire=wire,
            path=request.path,
            raw=request.body,
            model=request.named.get("model"),
            slot=request.headers.get(SLOT_HEADER),
            attempt=request.headers.get(ATTEMPT_HEADER, ""),
        )
        try:
            question = self._replies.question(asked)
        except UsageError as exc:
            return as_error(wire, 400, str(exc))
        attempt = self._replies.attempt(asked)
        fault = self._faults.fault(asked.where, attempt)
        await asyncio.sleep(self._faults.latency_s)
        if fault == "hang":
            await asyncio.sleep(self._faults.hang_s)
        if fault in ("hang", "reset", "truncated_body"):
            raise BrokenOff(fault)
        if fault == "bad_gateway":
            return Response(b"<html>502 Bad Gateway</html>", 502, {"content-type": "text/plain"})
        if fault == "rate_limit":
            delay_s = self._faults.wait_s(asked.where, attempt)
            return as_error(wire, 429, "Rate limit reached.", delay_s)
        if fault in STATUS_FAULTS:
            return as_error(wire, STATUS_FAULTS[fault], "An emulated fault.")
        reply = self._replies.answer(question, attempt, fault)
        return Response(dumps(reply)[: -20 if fault == "truncated_json" else None])


def headers_of(asked: Mapping[str, str]) -> dict[str, str]:
    """Return the headers of each response to a request with the headers ``asked``.

    They say that a mock model made it, even an error or what is no JSON, and repeat the request's
    id, as many gateways do.
    """
    told = {SCRIPTED_HEADER: "true"}
    if ID_HEADER in asked:
        told[ID_HEADER] = asked[ID_HEADER]
    return told


class InProcess(httpx.AsyncBaseTransport):
    """Carries requests to an emulator in this process: no server, no socket."""

    def __init__(self, emulator: Emulator) -> None:
        self._emulator = emulator

    async def handle_async_request(self, request: httpx.Request) -> httpx.Response:
        """Answer a request; raises httpx.ReadError where the emulator breaks off."""
        asked = Request(
            method=request.method,
            path=request.url.path,
            host=request.url.netloc.decode(),
            headers=request.headers,
            query=request.url.params,
            body=await request.aread(),
        )
        try:
            response = await self._emulator.respond(asked)
        except BrokenOff as exc:
            raise httpx.ReadError(str(exc)) from exc
        headers = {**response.headers, **headers_of(request.headers)}
        # A stream, which the client reads as it reads any other.
        body = httpx.ByteStream(response.body)
        return httpx.Response(response.status, headers=headers, stream=body)
