"""The live transport: httpx on aiohttp's connections."""

from __future__ import annotations

import asyncio
import itertools
import ssl
from collections.abc import AsyncIterator, Awaitable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any, TypeVar
from uuid import uuid4

import aiohttp
import httpx
from httpx_aiohttp import AiohttpTransport, HttpxAiohttpClient

from merge_runner.config import LOOPBACK, SHORTEST_SECRET, Endpoint, proxy_secrets
from merge_runner.errors import UsageError
from merge_runner.llm.bodies import ENCODING, read_body, read_lines
from merge_runner.llm.connections import Connections, Trust
from merge_runner.llm.content_hashes import canonical_json
from merge_runner.llm.http_outcome import RawReply
from merge_runner.llm.masking import Mask
from merge_runner.llm.transport import ErrorReply, TransportFailure
from merge_runner.records import ATTEMPT_HEADER, SLOT_HEADER, ChatRequest

NO_TIMEOUT = {"timeout": httpx.Timeout(None).as_dict()}
# Many servers and gateways echo one of these.
ID_HEADERS = ("x-request-id", "x-client-request-id")
MOST_BYTES = 16_000_000
T = TypeVar("T")


class NoCookies(httpx.Cookies):
    """Takes no cookie: one would tie calls together that should be independent samples."""

    def extract_cookies(self, response: httpx.Response) -> None:
        """Leave them where they are."""


class StrictClient(HttpxAiohttpClient):
    """Keeps no cookie, neither of its own nor of the connections', and no doubtful connection."""

    def __init__(self, trust: Trust, **options: Any) -> None:  # noqa: ANN401 # those of httpx.AsyncClient
        self._trust = trust
        super().__init__(**options)
        self._cookies = NoCookies()

    def _init_transport(self, *args: Any, **options: Any) -> httpx.AsyncBaseTransport:  # noqa: ANN401
        return self._strict(super()._init_transport(*args, **options))

    def _init_proxy_transport(self, *args: Any, **options: Any) -> httpx.AsyncBaseTransport:  # noqa: ANN401
        return self._strict(super()._init_proxy_transport(*args, **options))

    def _strict(self, transport: httpx.AsyncBaseTransport) -> httpx.AsyncBaseTransport:
        """The same transport with a session of our own; one that was given stays as it is."""
        if not isinstance(transport, AiohttpTransport):
            return transport
        limits, ssl_context = transport.limits, transport.ssl_context

        def session() -> aiohttp.ClientSession:
            connector = Connections(
                self._trust,
                limit=limits.max_connections or 0,
                keepalive_timeout=limits.keepalive_expiry,
                ssl=ssl_context,
            )
            return aiohttp.ClientSession(connector=connector, cookie_jar=aiohttp.DummyCookieJar())

        transport.client = session
        return transport


class HttpTransport:
    """Sends requests to one endpoint over at most ``connections`` connections.

    A reply of more than ``most_bytes`` is refused. Proxies are those that httpx reads from the
    environment; loopback never goes through one. Only our own emulator is told the slot. Each
    attempt has a random id; an answer that names another one is not taken. A ``carrier`` takes the
    requests in the place of connections.
    """

    def __init__(
        self,
        endpoint: Endpoint,
        *,
        connections: int,
        most_bytes: int = MOST_BYTES,
        carrier: httpx.AsyncBaseTransport | None = None,
    ) -> None:
        self._endpoint = endpoint
        self._most_bytes = most_bytes
        keys = (value.removeprefix("Bearer ") for value in endpoint.auth_headers.values())
        secrets = {*keys, *proxy_secrets()}
        self._mask = Mask(secret for secret in secrets if len(secret) >= SHORTEST_SECRET)
        self._trust = Trust()
        # Each id is a UUID, as some servers demand (llama-cpp-python): a random part, this
        # transport's own, and the number of the request.
        self._own = str(uuid4())[:24]
        self._ids = map("{:012x}".format, itertools.count(1))
        self._client = _client(endpoint.base_url, connections, self._trust, carrier)
        self._headers = {
            **self._client.headers,
            "accept-encoding": ENCODING,
            "content-type": "application/json",
        }
        self._urls: dict[str, httpx.URL] = {}

    async def send(self, request: ChatRequest, *, attempt: int, timeout_s: float) -> RawReply:
        """Post the hashed bytes; raises TransportFailure."""
        headers = request.headers
        if self._endpoint.is_emulator:
            slot = canonical_json(request.slot.as_dict())
            headers = {**headers, SLOT_HEADER: slot, ATTEMPT_HEADER: str(attempt)}
        body = request.body.encode()
        return await self.ask("POST", request.path, headers, body, timeout_s=timeout_s)

    async def get(self, path: str, *, timeout_s: float) -> RawReply:
        """Ask for what the server tells of itself; raises TransportFailure."""
        return await self.ask("GET", path, {}, timeout_s=timeout_s)

    async def ask(
        self,
        method: str,
        path: str,
        headers: Mapping[str, str],
        body: bytes = b"",
        *,
        timeout_s: float,
        most_bytes: int | None = None,
    ) -> RawReply:
        """Ask for anything; raises TransportFailure."""
        own_id = self._own + next(self._ids)
        request = self._http_request(method, path, headers, body, own_id)
        with self._failures(timeout_s):
            async with asyncio.timeout(timeout_s):
                reply = await self._client.send(request, stream=True)
                try:
                    self._check_id(reply, own_id)
                    return await self._read(reply, most_bytes or self._most_bytes)
                finally:
                    await reply.aclose()

    async def lines(
        self, path: str, headers: Mapping[str, str], *, timeout_s: float
    ) -> AsyncIterator[str | TransportFailure]:
        """Get a body of lines, each up to ``most_bytes`` long, or why it is refused.

        Nothing may be late by more than ``timeout_s``. Raises ErrorReply where the status is not
        200, and TransportFailure.
        """
        own_id = self._own + next(self._ids)
        request = self._http_request("GET", path, headers, b"", own_id)
        with self._failures(timeout_s):
            reply = await _within(timeout_s, self._client.send(request, stream=True))
            try:
                self._check_id(reply, own_id)
                if reply.status_code != 200:
                    raise ErrorReply(await _within(timeout_s, self._read(reply, self._most_bytes)))
                encoding = reply.headers.get("content-encoding", "")
                chunks = _in_time(reply.aiter_raw(), timeout_s)
                async for line in read_lines(chunks, encoding, self._most_bytes):
                    yield self._mask(line) if isinstance(line, str) else line
            finally:
                await reply.aclose()

    @contextmanager
    def _failures(self, timeout_s: float) -> Iterator[None]:
        """Turn every error of the libraries into a TransportFailure."""
        try:
            yield
        except TransportFailure:
            self._trust.doubted = True
            raise
        except TimeoutError as exc:
            self._trust.doubted = True
            raise TransportFailure("timeout", f"no reply within {timeout_s:.0f} s") from exc
        except (httpx.RequestError, aiohttp.ClientError) as exc:
            raise self._failure(exc) from exc

    async def _read(self, reply: httpx.Response, most_bytes: int) -> RawReply:
        encoding = reply.headers.get("content-encoding", "")
        body = await read_body(reply.aiter_raw(), encoding, most_bytes)
        # A provider may echo the key in an error; it must not get into a log or a database.
        headers = {name.lower(): value for name, value in reply.headers.items()}
        return RawReply(reply.status_code, headers, self._mask(body))

    def _http_request(
        self, method: str, path: str, headers: Mapping[str, str], body: bytes, own_id: str
    ) -> httpx.Request:
        """The request, made without the client, which would compose all its headers each time."""
        sent = {**self._headers, **headers, **self._endpoint.auth_headers}
        sent |= dict.fromkeys(ID_HEADERS, own_id)
        if self._trust.one_each:
            sent["connection"] = "close"
        return httpx.Request(
            method, self._url(path), headers=sent, content=body, extensions=NO_TIMEOUT
        )

    def _check_id(self, reply: httpx.Response, own_id: str) -> None:
        """Refuse the answer to another of our requests, where the server says whose it is."""
        said = [part.strip() for h in ID_HEADERS for part in reply.headers.get(h, "").split(",")]
        ours = [part for part in said if part.startswith(self._own)]
        self._trust.tied = bool(ours)
        if set(ours) - {own_id}:
            raise TransportFailure("wrong_answer", "the server sent the answer to another request")

    def _failure(self, error: Exception) -> TransportFailure:
        """What an error of the libraries means: whatever it is, there is no reply."""
        # httpx reports refused, reset and cut connections alike; what aiohttp said is its cause.
        reason = self._mask(str(error)) or type(error).__name__
        cause = error.__cause__ or error
        if isinstance(cause, aiohttp.ClientConnectorCertificateError):
            return TransportFailure("bad_certificate", reason, sent=False, action="refused")
        if isinstance(cause, aiohttp.ClientConnectorError):
            return TransportFailure("no_connection", self._unreached(cause, reason), sent=False)
        self._trust.doubted = True
        return TransportFailure("connection_lost", reason)

    def _unreached(self, error: aiohttp.ClientConnectorError, reason: str) -> str:
        proxy = isinstance(error, aiohttp.ClientProxyConnectionError)
        if isinstance(error.os_error, ConnectionRefusedError) and not proxy:
            return f"nothing listens at {self._endpoint.base_url}"
        return f"{self._endpoint.base_url} cannot be reached ({reason})"

    def _url(self, path: str) -> httpx.URL:
        """The URL of a path, which is never at another host: the key goes to the configured one."""
        if path not in self._urls:
            try:
                url = httpx.URL(self._endpoint.base_url + path)
            except httpx.InvalidURL as exc:
                raise _no_path(path) from exc
            if url.netloc != httpx.URL(self._endpoint.base_url).netloc:
                raise _no_path(path)
            self._urls[path] = url
        return self._urls[path]

    async def close(self) -> None:
        """Close all connections."""
        await self._client.aclose()


def _no_path(path: str) -> UsageError:
    return UsageError(f"{path[:60]!r} can be no path: correct the entry in experiments/models.toml")


async def _within(seconds: float, awaited: Awaitable[T]) -> T:
    async with asyncio.timeout(seconds):
        return await awaited


async def _in_time(chunks: AsyncIterator[bytes], timeout_s: float) -> AsyncIterator[bytes]:
    """The chunks; raises TimeoutError where one is late."""
    while (chunk := await _within(timeout_s, anext(chunks, None))) is not None:
        yield chunk


def _client(
    base_url: str, connections: int, trust: Trust, carrier: httpx.AsyncBaseTransport | None
) -> StrictClient:
    """A client with the proxies and certificates of the environment; raises UsageError."""
    url = httpx.URL(base_url)
    by_loopback = url.host in LOOPBACK
    # An empty one where there is no TLS, since to load the certificates takes long.
    trusted = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    try:
        if url.scheme == "https" or not by_loopback:
            trusted = httpx.create_ssl_context()
    except OSError as exc:
        raise UsageError(
            f"the certificates that SSL_CERT_FILE names cannot be read ({exc.strerror or exc}): "
            "correct it or unset it"
        ) from exc
    try:
        return StrictClient(
            trust,
            transport=carrier,
            verify=trusted,
            trust_env=not by_loopback,  # the proxies, since the certificates are given
            limits=httpx.Limits(max_connections=connections, max_keepalive_connections=connections),
            timeout=None,  # every attempt runs under its own timeout
        )
    except (ValueError, httpx.InvalidURL) as exc:
        raise UsageError(
            "the proxies of HTTP_PROXY, HTTPS_PROXY, ALL_PROXY and NO_PROXY cannot be read: "
            "correct them or unset them"
        ) from exc
