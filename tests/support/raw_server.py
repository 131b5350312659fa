"""A server of bytes, for what HTTP libraries are too polite to say.

    async with raw_server(ok(CHAT) + b"surplus", ok(CHAT)) as server:
        ...  # a client of server.url
    assert [request.talk for request in server.requests] == [1, 2]

The first request, over all connections, meets the first answer, and so on; all later ones meet the
last. An answer is bytes, after which the connection stays open, or a coroutine function of the talk
and the request, which may say anything at any time:

    async def late(talk, request):
        await asyncio.sleep(0.2)
        await talk.say(ok(CHAT) * 2)
"""

import asyncio
import contextlib
import json
import ssl
from collections.abc import AsyncIterator, Awaitable, Callable
from dataclasses import dataclass, field

from merge_runner.llm.http import HttpTransport
from merge_runner.providers import Endpoint
from merge_runner.records import ChatRequest, Slot, make_request

# A reply that every client of the format openai-chat takes for an answer.
CHOICE = {"message": {"content": "an answer"}, "finish_reason": "stop"}
USAGE = {"prompt_tokens": 1, "completion_tokens": 1}
CHAT = json.dumps({"id": "1", "model": "m", "choices": [CHOICE], "usage": USAGE}).encode()


def a_request(number: int = 0, prompt: str | None = None, slot: Slot | None = None) -> ChatRequest:
    """What a client sends to any such server."""
    named = {"provider": "openai", "endpoint": "openai", "model": "m", "path": "/chat/completions"}
    body = {"prompt": prompt or f"number {number}"}
    slot = slot or Slot("N_0_0", 1, "left", number, 0)
    return make_request(**named, headers={}, body=body, slot=slot)


def head(status: int = 200, **headers: object) -> bytes:
    """The head of a response; an underscore in a header's name stands for a hyphen."""
    lines = [f"HTTP/1.1 {status} X", *(f"{k.replace('_', '-')}: {v}" for k, v in headers.items())]
    return "\r\n".join([*lines, "", ""]).encode("latin-1")


def ok(body: bytes = CHAT, status: int = 200, **headers: object) -> bytes:
    """A whole response, with its length."""
    named = {"content_type": "application/json", **headers, "content_length": len(body)}
    return head(status, **named) + body


@dataclass(frozen=True)
class Request:
    """What was asked: ``talk`` is the number of its connection, from 1."""

    talk: int
    head: bytes
    body: bytes

    @property
    def headers(self) -> dict[str, str]:
        """By lower-case name."""
        lines = self.head.decode("latin-1").split("\r\n")[1:]
        pairs = (line.split(":", 1) for line in lines if line)
        return {name.lower(): value.strip() for name, value in pairs}


@dataclass
class Talk:
    """One connection, from the server's side."""

    number: int
    reader: asyncio.StreamReader
    writer: asyncio.StreamWriter

    async def request(self) -> Request:
        """The next request; raises asyncio.IncompleteReadError where there is none."""
        request = Request(self.number, await self.reader.readuntil(b"\r\n\r\n"), b"")
        length = int(request.headers.get("content-length", 0))
        return Request(self.number, request.head, await self.reader.readexactly(length))

    async def say(self, data: bytes) -> None:
        """Send bytes as they are."""
        self.writer.write(data)
        await self.writer.drain()

    async def drip(self, data: bytes, every_s: float) -> None:
        """Send byte after byte."""
        for byte in data:
            await self.say(bytes([byte]))
            await asyncio.sleep(every_s)

    def half_close(self) -> None:
        """Say that nothing more comes, and go on listening."""
        self.writer.write_eof()

    def close(self) -> None:
        """Close in order."""
        self.writer.close()

    async def left(self) -> None:
        """Wait until the client has closed, whatever it sends before."""
        while await self.reader.read(65536):
            pass


Answer = bytes | Callable[[Talk, Request], Awaitable[None]]


@dataclass
class RawServer:
    """What was asked; ``left`` has the numbers of the connections that the client has closed."""

    url: str = ""
    requests: list[Request] = field(default_factory=list)
    left: list[int] = field(default_factory=list)


@contextlib.asynccontextmanager
async def raw_server(
    *answers: Answer, tls: ssl.SSLContext | None = None
) -> AsyncIterator[RawServer]:
    """Serve on loopback; on leaving, all connections are dropped."""
    seen = RawServer()
    talks: list[asyncio.Task[None]] = []

    async def serve(talk: Talk) -> None:
        # Whatever ends a talk, the client has left or is about to.
        with contextlib.suppress(ConnectionError, asyncio.IncompleteReadError):
            while not talk.writer.is_closing():
                request = await talk.request()
                seen.requests.append(request)
                answer = answers[min(len(seen.requests), len(answers)) - 1]
                await (talk.say(answer) if isinstance(answer, bytes) else answer(talk, request))
        seen.left.append(talk.number)
        talk.close()

    def begin(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        talks.append(asyncio.create_task(serve(Talk(len(talks) + 1, reader, writer))))

    server = await asyncio.start_server(begin, "127.0.0.1", 0, ssl=tls)
    scheme = "https" if tls else "http"
    seen.url = f"{scheme}://127.0.0.1:{server.sockets[0].getsockname()[1]}"
    try:
        yield seen
    finally:
        server.close()
        for task in talks:
            task.cancel()
        await asyncio.gather(*talks, return_exceptions=True)


@contextlib.asynccontextmanager
async def transport_to(
    endpoint: Endpoint | str, connections: int = 1, **options: object
) -> AsyncIterator[HttpTransport]:
    """A transport to an endpoint, or to that of OpenAI's format at a URL."""
    if isinstance(endpoint, str):
        endpoint = Endpoint("openai", "openai", endpoint, {})
    transport = HttpTransport(endpoint, connections=connections, **options)
    try:
        yield transport
    finally:
        await transport.close()
