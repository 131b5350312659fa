"""The emulator as an HTTP server, on loopback only."""

from __future__ import annotations

import asyncio
from collections.abc import Callable

import httpx
from aiohttp import web

from merge_runner.emulator.handler import Emulator
from merge_runner.errors import UsageError

HOST = "127.0.0.1"
# Requests to any other host name are refused.
OWN_NAMES = ("127.0.0.1", "localhost", "[::1]")
ID_HEADER = "x-request-id"
MOST_BYTES = 2**29


def application(emulator: Emulator | None = None) -> web.Application:
    """Return an emulator as an application of aiohttp."""
    handler = emulator or Emulator()

    async def respond(request: web.Request) -> web.StreamResponse:
        port = request.get_extra_info("sockname", ("", 0))[1]  # none if the client has gone
        # A web page whose host name resolves to loopback (DNS rebinding) sends that name.
        if request.headers.get("host", "").lower().removesuffix(f":{port}") not in OWN_NAMES:
            text = f"This is the emulator of merge-runner: ask for {HOST}:{port}."
            return web.Response(status=403, text=text)
        headers, body = list(request.headers.items()), await request.read()
        response = await handler.respond(
            httpx.Request(request.method, str(request.url), headers=headers, content=body)
        )
        answer = web.Response(status=response.status_code, headers=response.headers)
        answer.body = await response.aread()
        if ID_HEADER in request.headers:  # as many gateways do
            answer.headers[ID_HEADER] = request.headers[ID_HEADER]
        return answer

    app = web.Application(client_max_size=MOST_BYTES)
    app.router.add_route("*", "/{path:.*}", respond)
    return app


async def serve(port: int, app: web.Application | None = None) -> tuple[web.AppRunner, str]:
    """Start an emulator on a loopback port (0: any free one); return it with its base URL."""
    runner = web.AppRunner(app or application(), access_log=None, shutdown_timeout=0.1)
    await runner.setup()
    try:
        await web.TCPSite(runner, HOST, port, backlog=4096).start()
    except OSError as exc:
        await runner.cleanup()
        raise UsageError(f"port {port} cannot be used: {exc}; --port 0 takes any") from exc
    bound: int = runner.addresses[0][1]
    return runner, f"http://{HOST}:{bound}"


async def run(port: int, *, announce: Callable[[str], None]) -> None:
    """Announce the base URL, and serve until cancelled."""
    runner, url = await serve(port)
    announce(url)
    try:
        await asyncio.Event().wait()
    finally:
        await runner.cleanup()
