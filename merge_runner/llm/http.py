"""The live transport: httpx on aiohttp's connections."""

from __future__ import annotations

import asyncio
from typing import Any

import aiohttp
import httpx
from httpx_aiohttp import AiohttpTransport, HttpxAiohttpClient

from merge_runner.config import Endpoint
from merge_runner.llm.keys import canonical_json
from merge_runner.llm.transport import TransportFailure
from merge_runner.llm.verdicts import RawReply
from merge_runner.records import ATTEMPT_HEADER, SLOT_HEADER, ChatRequest

# A shorter dummy key may be part of any text.
SHORTEST_SECRET = 8
NO_TIMEOUT = {"timeout": httpx.Timeout(None).as_dict()}
LOOPBACK = ("127.0.0.1", "localhost", "[::1]")


class NoCookies(httpx.Cookies):
    """Takes none: one would tie calls together that should be independent samples."""

    def extract_cookies(self, response: httpx.Response) -> None:
        """Leave them where they are."""


class CookielessClient(HttpxAiohttpClient):
    """Keeps no cookie, neither of its own nor of the connections'."""

    def __init__(self, **options: Any) -> None:  # noqa: ANN401 # those of httpx.AsyncClient
        super().__init__(**options)
        self._cookies = NoCookies()

    def _init_transport(self, *args: Any, **options: Any) -> httpx.AsyncBaseTransport:  # noqa: ANN401
        return _cookieless(super()._init_transport(*args, **options))

    def _init_proxy_transport(self, *args: Any, **options: Any) -> httpx.AsyncBaseTransport:  # noqa: ANN401
        return _cookieless(super()._init_proxy_transport(*args, **options))


def _cookieless(transport: httpx.AsyncBaseTransport) -> httpx.AsyncBaseTransport:
    """The same transport with a session that ignores cookies."""
    assert isinstance(transport, AiohttpTransport)
    limits, ssl_context = transport.limits, transport.ssl_context

    def session() -> aiohttp.ClientSession:
        connector = aiohttp.TCPConnector(
            limit=limits.max_connections or 0,
            keepalive_timeout=limits.keepalive_expiry,
            ssl=ssl_context,
        )
        return aiohttp.ClientSession(connector=connector, cookie_jar=aiohttp.DummyCookieJar())

    transport.client = session
    return transport


class HttpTransport:
    """Sends requests to one endpoint over at most ``connections`` connections.

    Proxies are those that httpx reads from the environment; loopback never goes through one.
    Our own emulator, and nobody else, is told the slot.
    """

    def __init__(self, endpoint: Endpoint, *, connections: int) -> None:
        self._endpoint = endpoint
        self._secrets = [
            secret
            for value in endpoint.auth_headers.values()
            if len(secret := value.removeprefix("Bearer ")) >= SHORTEST_SECRET
        ]
        limits = httpx.Limits(max_connections=connections, max_keepalive_connections=connections)
        self._client = CookielessClient(
            limits=limits,
            mounts={f"all://{host}": None for host in LOOPBACK},
            timeout=None,  # every attempt runs under its own timeout
        )
        self._headers = {**self._client.headers, "content-type": "application/json"}
        self._urls: dict[str, httpx.URL] = {}

    async def send(self, request: ChatRequest, *, attempt: int, timeout_s: float) -> RawReply:
        """Post the hashed bytes; raises TransportFailure."""
        headers = {**self._headers, **request.headers, **self._endpoint.auth_headers}
        if self._endpoint.provider == "emulator":
            headers[SLOT_HEADER] = canonical_json(request.slot.as_dict())
            headers[ATTEMPT_HEADER] = str(attempt)
        # Made without the client, which would put the same together from its defaults each time.
        asked = httpx.Request(
            "POST",
            self._url(request.path),
            headers=headers,
            content=request.body.encode(),
            extensions=NO_TIMEOUT,
        )
        try:
            async with asyncio.timeout(timeout_s):
                reply = await self._client.send(asked)
        except TimeoutError as exc:
            raise TransportFailure("timeout", f"no reply within {timeout_s:.0f} s") from exc
        except (httpx.RequestError, aiohttp.ClientError) as exc:
            # The libraries report refused, reset and cut connections alike, and pass on some
            # errors of the other's: whatever it is, there is no reply.
            reason = str(exc) or type(exc).__name__
            if isinstance(exc.__cause__ or exc, aiohttp.ClientConnectorError):
                raise TransportFailure("no_connection", reason, sent=False) from exc
            raise TransportFailure("connection_lost", reason) from exc
        body = reply.text
        # A provider may echo the key in an error; it must not get into a log or a database.
        for secret in self._secrets:
            body = body.replace(secret, "[key]")
        return RawReply(reply.status_code, {k.lower(): v for k, v in reply.headers.items()}, body)

    def _url(self, path: str) -> httpx.URL:
        if path not in self._urls:
            self._urls[path] = httpx.URL(self._endpoint.base_url + path)
        return self._urls[path]

    async def close(self) -> None:
        """Close all connections."""
        await self._client.aclose()
