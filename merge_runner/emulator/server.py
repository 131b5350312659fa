"""The emulator's HTTP server, on loopback only."""

from __future__ import annotations

import asyncio
import hashlib
import json
import re
import socket
import struct
import sys
from collections import Counter
from collections.abc import Awaitable, Callable
from functools import partial
from typing import Any

from aiohttp import web

from merge_runner.config import validated
from merge_runner.emulator.driver import answer
from merge_runner.emulator.faults import FaultPlan
from merge_runner.emulator.formats import SERVED, Said, ServedFormat
from merge_runner.errors import UsageError
from merge_runner.planted_effect import PlantedEffect, planted_fields
from merge_runner.records import (
    ANSWERED_FIELD,
    ATTEMPT_HEADER,
    SCRIPTED_FIELD,
    SCRIPTED_HEADER,
    SIDES,
    SLOT_HEADER,
    Slot,
)

HOST = "127.0.0.1"
# The names under which a browser or a client may reach it.
OWN_NAMES = ("127.0.0.1", "localhost", "[::1]")
MODELS = ("scripted-driver",)
STATUS_FAULTS = {
    "request_timeout": 408,
    "conflict": 409,
    "server_error": 500,
    "overloaded": 503,
}
# What anything but a chat request can raise: refused with 400.
UNREADABLE = (ValueError, TypeError, AttributeError, KeyError, IndexError, RecursionError)
# What the model says in place of the driver's answer.
TEXTS = {
    "malformed": "M\n\nI would rather describe my plan in words than write a list of numbers.",
    "empty": "",
}
ID_HEADER = "x-request-id"
# A linger time of zero sends a reset instead of an orderly close.
RESET_AT_CLOSE = struct.pack("ii", 1, 0)
Handler = Callable[[web.Request], Awaitable[web.StreamResponse]]


class Emulator:
    """Answers chat requests of every format in SERVED; ``faults`` decides what goes wrong."""

    def __init__(self, faults: FaultPlan | None = None) -> None:
        self._faults = faults or FaultPlan()
        self._asked: Counter[str] = Counter()
        self.app = web.Application(client_max_size=2**22, middlewares=[_only_by_own_name])
        self.app.on_response_prepare.append(_say_scripted)
        self.app.add_routes(
            [
                *(web.post(each.path, partial(self._serve, each)) for each in SERVED),
                web.get("/v1/models", self._models),
            ]
        )

    async def _models(self, request: web.Request) -> web.StreamResponse:
        listed = [{"id": model, "object": "model", "owned_by": "emulator"} for model in MODELS]
        return web.json_response({"object": "list", "data": listed})

    async def _serve(self, wire: ServedFormat, request: web.Request) -> web.StreamResponse:
        raw = await request.read()
        try:
            body = json.loads(raw)
            slot = _slot(request.headers.get(SLOT_HEADER))
            prompt = wire.prompt(body)
            model = request.match_info.get("model") or str(body.get("model", MODELS[0]))
            (prompt + model).encode()
            planted = planted_fields(wire.parameters(body))
        except UNREADABLE:
            return _error(wire, 400, "The body is not valid.")
        try:
            effect = validated(PlantedEffect, planted, "the emulator") if planted else None
        except UsageError as exc:
            return _error(wire, 400, str(exc))
        where = request.headers.get(SLOT_HEADER) or hashlib.sha256(raw).hexdigest()
        attempt = self._attempt(request, where)
        fault = self._faults.fault(where, attempt)
        await asyncio.sleep(self._faults.latency_s)
        if fault in ("hang", "reset", "truncated_body"):
            return await self._break_off(request, fault)
        if fault == "bad_gateway":
            return web.Response(status=502, text="<html>502 Bad Gateway</html>")
        if fault == "rate_limit":
            return _error(wire, 429, "Rate limit reached.", self._faults.wait_s(where, attempt))
        if fault in STATUS_FAULTS:
            return _error(wire, STATUS_FAULTS[fault], "An emulated fault.")
        text = TEXTS[fault] if fault in TEXTS else answer(prompt, slot, effect)
        # Only the same attempt at the same request gets the same id: the audit takes one that
        # comes back for an answer that was given twice.
        reply_id = hashlib.sha256(raw + f"{request.path} {where} {attempt}".encode()).hexdigest()
        reply = wire.answer(Said(reply_id[:24], model, prompt, text, fault == "refused"))
        reply[ANSWERED_FIELD] = {
            "body_sha256": hashlib.sha256(raw).hexdigest(),
            "slot": slot and slot.as_dict(),
        }
        sent = _dumps(reply)[: -20 if fault == "truncated_json" else None]
        return web.Response(body=sent, content_type="application/json")

    def _attempt(self, request: web.Request, where: str) -> int:
        """The attempt's number: the client's own count, or else how often this was asked."""
        told = request.headers.get(ATTEMPT_HEADER, "")
        self._asked[where] += 1
        return int(told) if re.fullmatch("[0-9]{1,6}", told) else self._asked[where]

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


def _slot(header: str | None) -> Slot | None:
    """The slot that a client sent; raises ValueError or TypeError for an impossible one."""
    if header is None:
        return None
    slot = Slot(**json.loads(header))
    numbers = (slot.repetition, slot.decision, slot.sample_set)
    known = isinstance(slot.condition, str) and slot.side in SIDES
    if not known or not all(type(number) is int for number in numbers):
        raise ValueError("no such slot")
    return slot


def _error(wire: ServedFormat, status: int, message: str, delay_s: float = 0.0) -> web.Response:
    body, headers = wire.error(status, message, delay_s)
    return web.Response(
        body=_dumps(body), status=status, headers=headers, content_type="application/json"
    )


def _dumps(body: dict[str, Any]) -> bytes:
    """A body as it is sent, with the field that says that no model made it."""
    return json.dumps({**body, SCRIPTED_FIELD: True}, ensure_ascii=False).encode()


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
