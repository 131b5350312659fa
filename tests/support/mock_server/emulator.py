"""The emulator with faults and batch modes, as a server on loopback."""

import asyncio
import json
import re
import socket
import struct
import threading
from collections import Counter
from contextlib import contextmanager

from aiohttp import web

from merge_runner.emulator import server
from merge_runner.emulator.handler import SERVED, Emulator, as_json, as_response
from merge_runner.llm.formats import FORMATS
from merge_runner.records import SCRIPTED_HEADER
from tests.support.mock_server.batches import MODES, Batches, BrokenOff
from tests.support.mock_server.faults import BREAKS, ERRORS, FaultPlan, as_error

NAMES = ("openai-chat", "openai-responses", "gemini", "anthropic")
WIRES = dict(zip((wire.path for wire in SERVED), NAMES, strict=True))
PROSE = "M\n\nI would rather describe my plan in words than write a list of numbers."
# A linger time of zero sends a reset instead of an orderly close.
RESET_AT_CLOSE = struct.pack("ii", 1, 0)


class FaultyEmulator(Emulator):
    """Fails as its plan says, plays batch modes, and counts its answers: each would be billed.

    What was answered without a ``custom_id`` was asked singly.
    """

    def __init__(self, plan=None):
        self.plan = plan or FaultPlan()
        super().__init__()
        self._answered = Counter()
        self._batches = Batches(self)
        self._routes = [route for mode in MODES for route in mode(self._batches).routes()]

    async def respond(self, request):
        """Answer a request; raises BrokenOff."""
        path = request.url.path
        if path == "/emulator/answered":
            self._batches.settle()
            names = ("body_sha256", "slot", "custom_id", "answered")
            counts = ((*asked, count) for asked, count in self._answered.items())
            return as_json([dict(zip(names, each, strict=True)) for each in counts])
        for method, pattern, handler in self._routes:
            if method == request.method and (named := re.fullmatch(pattern, path)):
                return handler(request, **named.groupdict())
        return await super().respond(request)

    async def reply(self, asked, attempt):
        """The response, or what takes its place; raises BrokenOff."""
        fault = self.plan.fault(asked.where, attempt)
        answer = self.answer(asked, attempt, fault)
        await asyncio.sleep(self.plan.latency_s)
        if fault == "hang":
            await asyncio.sleep(self.plan.hang_s)
        if fault in BREAKS:
            raise BrokenOff(fault)
        if fault == "bad_gateway":
            page = b"<html>502 Bad Gateway</html>"
            return as_response(page, 502, {"content-type": "text/plain"})
        if fault == "rate_limit":
            return as_error(asked.wire, 429, "Rate limit reached.", self.plan.delay_s)
        if fault in ERRORS:
            return as_error(asked.wire, ERRORS[fault], "An emulated fault.")
        response = as_json(answer)
        if fault == "truncated_json":
            return as_response((await response.aread())[:-20], 200, response.headers)
        return response

    def answer(self, asked, attempt, fault=None, custom_id=None):
        """The body of an answer, which is counted."""
        body = super().answer(asked, attempt)
        if fault not in (*ERRORS, *BREAKS, "rate_limit", "bad_gateway"):
            self._answered[asked.body_sha256, asked.slot, custom_id] += 1
        if fault in ("malformed", "empty"):
            text = json.dumps(FORMATS[WIRES[asked.wire.path]].read(body).text)
            said = json.dumps(PROSE if fault == "malformed" else "")
            body = json.loads(json.dumps(body).replace(text, said))
        return body


@web.middleware
async def _break_off(request, handler):
    """Cut the connection before or within the reply."""
    try:
        return await handler(request)
    except BrokenOff as exc:
        transport, fault = request.transport, str(exc)  # None once the client has gone
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


def application(plan: FaultPlan | None = None) -> web.Application:
    """An emulator as an application of aiohttp."""
    app = server.application(FaultyEmulator(plan))
    app.middlewares.append(_break_off)
    return app


async def serve(port, plan=None):
    """Start an emulator on a loopback port (0: any free one); returns it with its base URL."""
    return await server.serve(port, application(plan))


@contextmanager
def served(plan):
    """Serve an emulator by a thread of its own; yields its base URL."""
    loop = asyncio.new_event_loop()
    thread = threading.Thread(target=loop.run_forever)
    thread.start()
    runner, url = asyncio.run_coroutine_threadsafe(serve(0, plan), loop).result()
    try:
        yield url
    finally:
        asyncio.run_coroutine_threadsafe(runner.cleanup(), loop).result()
        loop.call_soon_threadsafe(loop.stop)
        thread.join()
        loop.close()
