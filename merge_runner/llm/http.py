"""Live transport: httpx on aiohttp's connections."""

from __future__ import annotations

import asyncio
import itertools
import json
import select
import socket
import ssl
from base64 import b64encode
from collections.abc import Iterator, Mapping
from contextlib import aclosing, suppress
from functools import lru_cache
from operator import attrgetter
from typing import TYPE_CHECKING, Any
from urllib.parse import unquote, urlsplit
from urllib.request import getproxies_environment, proxy_bypass
from uuid import uuid4
from weakref import WeakSet

import aiohttp
import httpx
from httpx_aiohttp import AiohttpTransport

from merge_runner.errors import UsageError
from merge_runner.llm.formats.wire import as_dict, as_dicts, as_text
from merge_runner.llm.http_outcome import Action, RawReply, TransportFailure
from merge_runner.llm.masking import Mask
from merge_runner.providers import LOOPBACK, SHORTEST_SECRET, Endpoint, http_url
from merge_runner.records import ATTEMPT_HEADER, SLOT_HEADER, ChatRequest

if TYPE_CHECKING:
    from aiohttp.client_proto import ResponseHandler
    from aiohttp.connector import Connection

SLOT_FIELDS = ("condition", "decision", "repetition", "sample_set", "side")
# Many servers and gateways echo one of these.
ID_HEADERS = ("x-request-id", "x-client-request-id")
MOST_BYTES = 16_000_000
# Some gateways send policies of more than the 8,190 bytes that aiohttp takes by default.
MOST_HEADER_BYTES = 65_536
KEPT_S = 5.0
# As the official SDKs set them: a router with address translation forgets a connection that is
# silent while a model thinks, and the answer would be lost.
ALIVE = {"TCP_KEEPIDLE": 60, "TCP_KEEPALIVE": 60, "TCP_KEEPINTVL": 60, "TCP_KEEPCNT": 5}
# A server that processes one call at a time may be busy with one.
LIST_TIMEOUT_S = 60.0
HEADERS = {
    "accept": "*/*",
    "accept-encoding": "gzip",
    "content-type": "application/json",
    "user-agent": "merge-runner",
}
# Statuses with which a proxy refuses all connections; others may be transient.
PROXY_REFUSES = frozenset({401, 403, 405, 407})
# Note of an error before there was a connection, as where a proxy hangs up.
NOT_SENT = "nothing was sent"
UNPACKABLE = "the reply is not in the Content-Encoding that it names"
# Part of aiohttp's message for a header beyond the bound.
TOO_LONG, LONGEST = "Got more than", 300


class HttpTransport:
    """Transport to one endpoint over at most ``connections`` connections.

    A reply of more than ``most_bytes`` is refused. The environment names proxies; loopback
    never goes through one. Only the emulator gets the slot. Each attempt has an id; a reply that
    echoes another request's id is refused. After a timeout, a truncated or an unexpected reply the
    endpoint is ``doubted``: connections are not reused unless the server echoes ids. A ``carrier``
    takes the requests instead of connections.
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
        self._sends_slot = endpoint.provider == "emulator"
        self._most_bytes = most_bytes
        keys = (value.removeprefix("Bearer ") for value in endpoint.auth_headers.values())
        secrets = {*keys, *proxy_secrets()}
        secrets = {secret for secret in secrets if len(secret) >= SHORTEST_SECRET}
        self._has_secrets, self._mask = bool(secrets), Mask(secrets)
        self.doubted = False
        self._echoes_ids = False
        # Each id is a UUID, as some servers demand (llama-cpp-python): a random prefix of this
        # transport, and the number of the request.
        self._id_prefix = str(uuid4())[:24]
        self._ids = map("{:012x}".format, itertools.count(1))
        self._carrier = carrier or self._network(connections)

    @property
    def single_use(self) -> bool:
        """True where each connection serves one request, so that no late reply is read."""
        return self.doubted and not self._echoes_ids

    async def send(self, request: ChatRequest, *, attempt: int, timeout_s: float) -> RawReply:
        """Post a request, byte for byte as hashed; raise TransportFailure."""
        headers = request.headers
        if self._sends_slot:
            # In the canonical form: the emulator's replies depend on it.
            values = dict(zip(SLOT_FIELDS, attrgetter(*SLOT_FIELDS)(request.slot), strict=True))
            slot = json.dumps(values, separators=(",", ":"))
            headers = {**headers, SLOT_HEADER: slot, ATTEMPT_HEADER: str(attempt)}
        body = request.body.encode()
        return await self.ask("POST", request.path, headers, body, timeout_s=timeout_s)

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
        """Send any request; every error of the libraries becomes a TransportFailure."""
        request_id = self._id_prefix + next(self._ids)
        sent = {**HEADERS, **headers, **self._endpoint.auth_headers}
        sent |= dict.fromkeys(ID_HEADERS, request_id)
        sent["connection"] = "close" if self.single_use else "keep-alive"
        url = url_of(self._endpoint.base_url, path, self._endpoint.place)
        # As a stream, since aiohttp adds Host and Content-Length itself.
        request = httpx.Request(method, url, headers=sent, stream=httpx.ByteStream(body))
        request.read()
        try:
            async with asyncio.timeout(timeout_s):
                reply = await self._carrier.handle_async_request(request)
                async with aclosing(reply):
                    headers = dict(reply.headers.items())  # httpx has their names in lower case
                    self._check_request_id(headers, request_id)
                    text = await self._read(reply, most_bytes or self._most_bytes)
                    return RawReply(reply.status_code, headers, text)
        except TransportFailure:
            self.doubted = True
            raise
        except TimeoutError as exc:
            self.doubted = True
            raise TransportFailure("timeout", f"no reply within {timeout_s:.0f} s") from exc
        except (httpx.RequestError, aiohttp.ClientError) as exc:
            raise self._failure(exc) from exc

    async def close(self) -> None:
        """Close all connections."""
        await self._carrier.aclose()

    def _check_request_id(self, headers: Mapping[str, str], request_id: str) -> None:
        """Raise TransportFailure where a reply echoes the id of another request."""
        self._echoes_ids = False
        for header in ID_HEADERS:
            for part in headers.get(header, "").split(","):
                echoed = part.strip()
                self._echoes_ids |= echoed.startswith(self._id_prefix)
                if echoed.startswith(self._id_prefix) and echoed != request_id:
                    why = "the server sent the reply to another request"
                    raise TransportFailure("wrong_answer", why)

    async def _read(self, reply: httpx.Response, most_bytes: int) -> str:
        body = bytearray()
        async for piece in reply.aiter_bytes():
            body += piece
            if len(body) > most_bytes:
                raise TransportFailure(
                    "reply_refused",
                    f"the reply is longer than {most_bytes / 1e6:g} MB (max_reply_mb)",
                    action="fail",
                )
        # JSON is UTF-8, whatever a header says. A provider may echo the key in an error, and no log
        # or database may contain it.
        text = body.decode("utf-8-sig", errors="replace")
        return self._mask(text) if self._has_secrets else text

    def _failure(self, error: Exception) -> TransportFailure:
        # httpx reports refused, reset and cut connections alike; aiohttp's error is its cause.
        reason = self._mask(str(error)) or type(error).__name__
        cause = error if isinstance(error, aiohttp.ClientError) else error.__cause__ or error
        if isinstance(error, httpx.DecodingError):
            return self._unreadable(f"{UNPACKABLE} ({reason})")
        if isinstance(cause, aiohttp.ClientHttpProxyError):
            host = httpx.URL(self._endpoint.base_url).netloc.decode()
            why = f"HTTP {cause.status}: {self._mask(cause.message)}"
            message = f"the proxy does not connect to {host} ({why})"
            action: Action = "rejected" if cause.status in PROXY_REFUSES else "retry"
            return TransportFailure(
                "proxy_refused", message, sent=False, action=action, reason="proxy_refused"
            )
        if isinstance(cause, aiohttp.ClientResponseError) and TOO_LONG in cause.message:
            words = self._mask(" ".join(cause.message.split()))[:LONGEST]
            return self._unreadable(f"a header is too long: {words}")
        if isinstance(cause, aiohttp.ClientConnectorCertificateError):
            return TransportFailure("bad_certificate", reason, sent=False, action="rejected")
        if isinstance(cause, aiohttp.ClientConnectorError):
            by_proxy = isinstance(cause, aiohttp.ClientProxyConnectionError)
            message = f"{self._endpoint.base_url} cannot be reached ({reason})"
            if isinstance(cause.os_error, ConnectionRefusedError) and not by_proxy:
                message = f"nothing listens at {self._endpoint.base_url}"
            return TransportFailure("no_connection", message, sent=False)
        self.doubted = True
        sent = NOT_SENT not in getattr(cause, "__notes__", ())
        return TransportFailure("connection_lost", reason, sent=sent)

    def _unreadable(self, why: str) -> TransportFailure:
        self.doubted = True
        return TransportFailure("connection_lost", why, reason="unreadable_reply")

    def _network(self, connections: int) -> AiohttpTransport:
        """Return a transport with the proxies and certificates of the environment."""
        url = httpx.URL(self._endpoint.base_url)
        # An empty one for plain HTTP to loopback, since loading the certificates takes long.
        trusted = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
        try:
            if url.scheme == "https" or url.host not in LOOPBACK:
                trusted = httpx.create_ssl_context()
        except OSError as exc:
            raise UsageError(
                "the certificates that SSL_CERT_FILE names cannot be read "
                f"({exc.strerror or exc}): correct it or unset it"
            ) from exc
        options = {"limit": connections, "keepalive_timeout": KEPT_S, "ssl": trusted}

        def session() -> aiohttp.ClientSession:
            return aiohttp.ClientSession(
                connector=Connections(self, **options),
                max_line_size=MOST_HEADER_BYTES,
                max_field_size=MOST_HEADER_BYTES,
                cookie_jar=aiohttp.DummyCookieJar(),  # one would tie independent samples together
            )

        proxies = getproxies_environment()
        proxy_url = proxies.get(url.scheme) or proxies.get("all")
        proxy = None
        if proxy_url and url.host not in LOOPBACK and not proxy_bypass(url.netloc.decode()):
            proxy_url = proxy_url if "://" in proxy_url else f"http://{proxy_url}"
            if http_url(proxy_url) is None:  # not shown: it may contain a password
                raise UsageError(
                    f"{url.scheme.upper()}_PROXY or ALL_PROXY is no URL of an HTTP proxy: set it "
                    "to http://HOST:PORT or unset it; a SOCKS proxy needs an HTTP proxy before it"
                )
            proxy = httpx.Proxy(proxy_url)
        return AiohttpTransport(verify=trusted, client=session, proxy=proxy)


class Connections(aiohttp.TCPConnector):
    """Connections that are reused only while nothing has arrived after the last reply."""

    def __init__(self, transport: HttpTransport, **options: Any) -> None:  # noqa: ANN401
        super().__init__(**options)
        self._transport = transport
        self._used: WeakSet[ResponseHandler] = WeakSet()

    async def connect(self, *args: Any, **options: Any) -> Connection:  # noqa: ANN401
        """Return a new connection, or a silent one."""
        while True:
            try:
                connection = await super().connect(*args, **options)
            except aiohttp.ClientError as exc:
                exc.add_note(NOT_SENT)
                raise
            handler, channel = connection.protocol, connection.transport
            assert handler is not None
            assert channel is not None
            if handler not in self._used:
                self._used.add(handler)
                keep_alive(channel.get_extra_info("socket"))
                return connection
            # The event loop may not have read yet what has arrived: ask the system.
            arrived = select.poll()
            arrived.register(channel.get_extra_info("socket").fileno(), select.POLLIN)
            self._transport.doubted |= handler.should_close
            if not (handler.should_close or arrived.poll(0) or self._transport.single_use):
                return connection
            connection.close()


def keep_alive(connection: socket.socket) -> None:
    """Switch TCP keep-alive on."""
    connection.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
    for name, value in ALIVE.items():
        if hasattr(socket, name):  # they differ between systems
            connection.setsockopt(socket.IPPROTO_TCP, getattr(socket, name), value)


@lru_cache
def url_of(base_url: str, path: str, place: str) -> httpx.URL:
    """Return the URL of a path at the configured host: no other host may get the key.

    Raises UsageError, with the ``place`` of the model's entry.
    """
    with suppress(httpx.InvalidURL):
        if path.startswith("/"):
            return httpx.URL(base_url + path)
    raise UsageError(f"{path[:60]!r} can be no path: correct {place}")


def proxy_secrets() -> Iterator[str]:
    """Yield user info and password of the proxies' URLs, as given, decoded and as sent."""
    for url in getproxies_environment().values():
        with suppress(ValueError):  # no URL: nothing is sent there
            info = urlsplit(url if "://" in url else f"//{url}").netloc.rpartition("@")[0]
            for given in {info, unquote(info)}:
                yield from (given, given.partition(":")[2], b64encode(given.encode()).decode())


async def listed_models(endpoint: Endpoint) -> list[str]:
    """Return the ids of the models that a server lists at ``GET /models``.

    Raises TransportFailure, ``no_list`` if there is no list.
    """
    transport = HttpTransport(endpoint, connections=1)
    try:
        raw = await transport.ask("GET", "/models", {}, timeout_s=LIST_TIMEOUT_S)
    finally:
        await transport.close()
    payload = as_dict(raw.payload)
    if raw.status != 200 or "data" not in payload:
        raise TransportFailure("no_list", f"HTTP {raw.status}: {raw.error.message or 'no list'}")
    return [name for model in as_dicts(payload["data"]) if (name := as_text(model.get("id")))]
