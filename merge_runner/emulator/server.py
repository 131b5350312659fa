"""The emulator's HTTP server, on loopback only."""

from __future__ import annotations

import asyncio
import socket
import struct
import sys
from collections.abc import Awaitable, Callable
from functools import partial

from aiohttp import web

from merge_runner.emulator.batches import AnthropicMode, Batches, GeminiMode, OpenAIMode
from merge_runner.emulator.faults import STATUS_FAULTS, FaultPlan
from merge_runner.emulator.formats import SERVED, ServedFormat
from merge_runner.emulator.replies import MODELS, Asked, Replies, dumps, marked
from merge_runner.errors import UsageError
from merge_runner.records import ATTEMPT_HEADER, SCRIPTED_HEADER, SLOT_HEADER

HOST = "127.0.0.1"
# The names under which a browser or a client may reach it.
OWN_NAMES = ("127.0.0.1", "localhost", "[::1]")
ID_HEADER = "x-request-id"
# A linger time of zero sends a reset instead of an orderly close.
RESET_AT_CLOSE = struct.pack("ii", 1, 0)
Handler = Callable[[web.Request], Awaitable[web.StreamResponse]]


class Emulator:
    """Answers chat requests of every format in SERVED; ``faults`` decides what goes wrong."""

    def __init__(self, faults: FaultPlan | None = None) -> None:
        self._faults = faults or FaultPlan()
        self._replies = Replies(self._faults)
        self._batches = Batches(self._replies)
        self.app = web.Application(client_max_size=2**22, middlewares=[_only_by_own_name])
        self.app.on_response_prepare.append(_say_scripted)
        self.app.add_routes(
            [
                *(web.post(each.path, partial(self._serve, each)) for each in SERVED),
                web.get("/v1/models", self._models),
                *OpenAIMode(self._batches).routes(),
                *AnthropicMode(self._batches).routes(),
                *GeminiMode(self._batches).routes(),
                web.get("/emulator/answered", self._answered),
            ]
        )

    async def _models(self, request: web.Request) -> web.StreamResponse:
        listed = [{"id": model, "object": "model", "owned_by": "emulator"} for model in MODELS]
        return web.json_response({"object": "list", "data": listed})

    async def _answered(self, request: web.Request) -> web.StreamResponse:
        """How often each request was answered, also in batches that nobody has fetched yet."""
        self._batches.settle()
        return web.json_response(self._replies.count())

    async def _serve(self, wire: ServedFormat, request: web.Request) -> web.StreamResponse:
        raw = await request.read()
        asked = Asked(
            wire=wire,
            path=request.path,
            raw=raw,
            model=request.match_info.get("model"),
            slot=request.headers.get(SLOT_HEADER),
            attempt=request.headers.get(ATTEMPT_HEADER, ""),
        )
        try:
            question = self._replies.question(asked)
        except UsageError as exc:
            return _error(wire, 400, str(exc))
        attempt = self._replies.attempt(asked)
        fault = self._faults.fault(asked.where, attempt)
        await asyncio.sleep(self._faults.latency_s)
        if fault in ("hang", "reset", "truncated_body"):
            return await self._break_off(request, fault)
        if fault == "bad_gateway":
            return web.Response(status=502, text="<html>502 Bad Gateway</html>")
        if fault == "rate_limit":
            delay_s = self._faults.wait_s(asked.where, attempt)
            return _error(wire, 429, "Rate limit reached.", delay_s)
        if fault in STATUS_FAULTS:
            return _error(wire, STATUS_FAULTS[fault], "An emulated fault.")
        reply = self._replies.answer(question, attempt, fault)
        sent = dumps(reply)[: -20 if fault == "truncated_json" else None]
        return web.Response(body=sent, content_type="application/json")

    async def _break_off(self, request: web.Request, fault: str) -> web.StreamResponse:
        """Say nothing for long, or cut the connection before or within the reply."""
        if fault == "hang":
            await asyncio.sleep(self._faults.hang_s)
        transport = request.transport  # None once the client has gone
        if transport is not None and fault == "truncated_body":
            transport.write(
                b"HTTP/1.1 200 OK\r\ncontent-type: application/json\r\n"
                b'%s: true\r\ncontent-length: 5000\r\n\r\n{"id": "cut' % SCRIPTED_HEADER.encode()
            )
            transport.close()
        elif transport is not None:
            if fault == "reset":
                connection = transport.get_extra_info("socket")
                connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, RESET_AT_CLOSE)
            transport.abort()
        return web.Response(status=500)  # which nobody gets: the connection has ended


async def _say_scripted(request: web.Request, response: web.StreamResponse) -> None:
    """Every response says that a stand-in made it, even an error or one that is not JSON.

    It repeats the id of its request, as many gateways do.
    """
    response.headers[SCRIPTED_HEADER] = "true"
    if ID_HEADER in request.headers:
        response.headers[ID_HEADER] = request.headers[ID_HEADER]


@web.middleware
async def _only_by_own_name(request: web.Request, handler: Handler) -> web.StreamResponse:
    """Refuse a web page whose own name resolves to loopback (DNS rebinding)."""
    assert request.transport is not None
    port = request.transport.get_extra_info("sockname")[1]
    host = request.headers.get("host", "").lower()
    if host.removesuffix(f":{port}") not in OWN_NAMES:
        return web.Response(
            status=403, text=f"This is the emulator of merge-runner: ask for {HOST}:{port}."
        )
    return await handler(request)


def _error(wire: ServedFormat, status: int, message: str, delay_s: float = 0.0) -> web.Response:
    body, headers = wire.error(status, message, delay_s)
    return web.Response(
        body=dumps(marked(body)), status=status, headers=headers, content_type="application/json"
    )


async def serve(port: int, faults: FaultPlan | None = None) -> tuple[web.AppRunner, str]:
    """Start the emulator on a loopback port (0: any free one); returns it with its base URL."""
    runner = web.AppRunner(Emulator(faults).app, access_log=None, shutdown_timeout=0.1)
    await runner.setup()
    try:
        await web.TCPSite(runner, HOST, port, backlog=4096).start()
    except OSError as exc:
        await runner.cleanup()
        raise UsageError(f"port {port} cannot be used: {exc}; --port 0 takes any") from exc
    bound: int = runner.addresses[0][1]
    return runner, f"http://{HOST}:{bound}"


async def run(
    port: int,
    faults: FaultPlan,
    *,
    announce: Callable[[str], None],
    until_stdin_closes: bool,
) -> None:
    """Serve until cancelled, or until standard input closes; announces the base URL."""
    runner, url = await serve(port, faults)
    announce(url)
    try:
        if until_stdin_closes:
            await asyncio.to_thread(sys.stdin.read)
        else:
            await asyncio.Event().wait()
    finally:
        await runner.cleanup()
