"""The emulator as an HTTP server, on loopback only."""

from __future__ import annotations

import asyncio
import socket
import struct
from collections.abc import Awaitable, Callable

from aiohttp import web

from merge_runner.emulator.exchange import BrokenOff, Request
from merge_runner.emulator.faults import FaultPlan
from merge_runner.emulator.handler import Emulator, headers_of
from merge_runner.errors import UsageError
from merge_runner.records import SCRIPTED_HEADER

HOST = "127.0.0.1"
# The names under which a browser or a client may reach it.
OWN_NAMES = ("127.0.0.1", "localhost", "[::1]")
MOST_BYTES = 2**29
# A linger time of zero sends a reset instead of an orderly close.
RESET_AT_CLOSE = struct.pack("ii", 1, 0)
Handler = Callable[[web.Request], Awaitable[web.StreamResponse]]


def application(faults: FaultPlan | None = None) -> web.Application:
    """Return an emulator as an application of aiohttp."""
    emulator = Emulator(faults)

    async def respond(request: web.Request) -> web.StreamResponse:
        asked = Request(
            method=request.method,
            path=request.path,
            host=request.host,
            headers=request.headers,
            query=request.query,
            body=await request.read(),
        )
        try:
            response = await emulator.respond(asked)
        except BrokenOff as exc:
            return _broken_off(request, exc.fault)
        return web.Response(body=response.body, status=response.status, headers=response.headers)

    app = web.Application(client_max_size=MOST_BYTES, middlewares=[_only_by_own_name])
    app.on_response_prepare.append(_add_headers)
    app.router.add_route("*", "/{path:.*}", respond)
    return app


def _broken_off(request: web.Request, fault: str) -> web.StreamResponse:
    """Cut the connection before or within the reply."""
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


async def _add_headers(request: web.Request, response: web.StreamResponse) -> None:
    response.headers.update(headers_of(request.headers))


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


async def serve(port: int, faults: FaultPlan | None = None) -> tuple[web.AppRunner, str]:
    """Start the emulator on a loopback port (0: any free one); returns it with its base URL."""
    runner = web.AppRunner(application(faults), access_log=None, shutdown_timeout=0.1)
    await runner.setup()
    try:
        await web.TCPSite(runner, HOST, port, backlog=4096).start()
    except OSError as exc:
        await runner.cleanup()
        raise UsageError(f"port {port} cannot be used: {exc}; --port 0 takes any") from exc
    bound: int = runner.addresses[0][1]
    return runner, f"http://{HOST}:{bound}"


async def run(port: int, faults: FaultPlan, *, announce: Callable[[str], None]) -> None:
    """Serve until cancelled; announces the base URL."""
    runner, url = await serve(port, faults)
    announce(url)
    try:
        await asyncio.Event().wait()
    finally:
        await runner.cleanup()
