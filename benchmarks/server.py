"""A loopback server that answers every chat completion at once, or after a delay, with one plan.

It is as small as a server can be, so that the client is measured. The delay stands in the
path: ``/delay/200/v1/chat/completions`` answers after 200 ms. ``GET /stats`` lists the requests,
``POST /reset`` forgets it.
"""

from __future__ import annotations

import asyncio
import hashlib
import json
import re
import signal
import sys
from collections import Counter
from itertools import count

# The right vehicle yields, so that most trials finish; what is no trial gets the first plan.
PLANS = {b"left": [0.0] * 20, b"right": [-0.4] * 20}
RATIONALE = "The other vehicle and I keep our speeds, so that the one ahead merges first. " * 22


def reply_parts(plan: list[float]) -> tuple[bytes, bytes, bytes]:
    """A reply of 2 KB: what stands before its id, between that and the model, and after that."""
    text = f"M\n{RATIONALE}\n```python\n{plan}\n```"
    message = {"role": "assistant", "content": text}
    reply = {
        "id": "ID",
        "object": "chat.completion",
        "created": 0,
        "model": "MODEL",
        "choices": [{"index": 0, "finish_reason": "stop", "message": message}],
        "usage": {"prompt_tokens": 1000, "completion_tokens": 500, "total_tokens": 1500},
    }
    start, rest = json.dumps(reply).encode().split(b"ID", 1)
    middle, end = rest.split(b"MODEL", 1)
    return start, middle, end


REPLIES = {side: reply_parts(plan) for side, plan in PLANS.items()}
_HEAD_END = b"\r\n\r\n"
_LENGTH = re.compile(rb"content-length: *(\d+)", re.IGNORECASE)
_SLOT = re.compile(rb"x-[a-z-]*slot: *([^\r]*)", re.IGNORECASE)
_SIDE = re.compile(rb'"side":"([a-z]+)"')
_DELAY = re.compile(rb"/delay/(\d+)/")
_MODEL = re.compile(rb'"model": ?"([^"]*)"')


class Seen:
    """Requests since the last reset: arrival times in s, and answers by request."""

    def __init__(self) -> None:
        self.arrivals: list[float] = []
        self.answered: Counter[bytes] = Counter()
        self.again = 0
        self.open = 0
        self.most_open = 0

    def stats(self) -> bytes:
        """All of it as JSON."""
        return json.dumps(
            {
                "asked": len(self.arrivals),
                "answered": self.answered.total(),
                "asked_again": self.again,
                "most_open": self.most_open,
                "arrivals": self.arrivals,
            }
        ).encode()


class Conversation(asyncio.Protocol):
    """One connection; requests are answered in the order in which they come."""

    seen = Seen()
    numbers = count()

    def __init__(self) -> None:
        self._loop = asyncio.get_running_loop()
        self._received = bytearray()
        self._transport: asyncio.Transport | None = None

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Keep the connection."""
        assert isinstance(transport, asyncio.Transport)
        self._transport = transport

    def connection_lost(self, exc: Exception | None) -> None:
        """Forget the connection."""
        self._transport = None

    def data_received(self, data: bytes) -> None:
        """Answer every request that is complete."""
        self._received += data
        while (end := self._received.find(_HEAD_END)) >= 0:
            head = bytes(self._received[:end])
            length = _LENGTH.search(head)
            whole = end + len(_HEAD_END) + (int(length.group(1)) if length else 0)
            if len(self._received) < whole:
                return
            body = bytes(self._received[end + len(_HEAD_END) : whole])
            del self._received[:whole]
            self._answer(head, body)

    def _answer(self, head: bytes, body: bytes) -> None:
        seen = Conversation.seen
        if head.startswith(b"GET /stats"):
            self._send(seen.stats())
            return
        if head.startswith(b"POST /reset"):
            Conversation.seen = Seen()
            self._send(b"{}")
            return
        seen.arrivals.append(self._loop.time())
        slot = _SLOT.search(head)
        request = hashlib.blake2b(body + (slot.group(1) if slot else b"")).digest()
        seen.again += request in seen.answered
        seen.open += 1
        seen.most_open = max(seen.most_open, seen.open)
        side, model = _SIDE.search(head), _MODEL.search(body)
        start, middle, end = REPLIES[side.group(1) if side else b"left"]
        number, name = str(next(self.numbers)).encode(), model.group(1) if model else b""
        reply = b"".join((start, number, middle, name, end))
        delay = _DELAY.search(head)
        if delay and int(delay.group(1)):
            self._loop.call_later(int(delay.group(1)) / 1000, self._reply, seen, request, reply)
        else:
            self._reply(seen, request, reply)

    def _reply(self, seen: Seen, request: bytes, reply: bytes) -> None:
        seen.open -= 1
        if self._transport is not None:
            seen.answered[request] += 1
            self._send(reply)

    def _send(self, body: bytes) -> None:
        assert self._transport is not None
        self._transport.write(
            b"HTTP/1.1 200 OK\r\ncontent-type: application/json\r\ncontent-length: %d\r\n\r\n%s"
            % (len(body), body)
        )


async def main() -> None:
    """Serve until terminated; prints the port."""
    loop = asyncio.get_running_loop()
    server = await loop.create_server(Conversation, "127.0.0.1", 0, backlog=4096)
    sys.stdout.write(f"{server.sockets[0].getsockname()[1]}\n")
    sys.stdout.flush()
    stopped = asyncio.Event()
    loop.add_signal_handler(signal.SIGTERM, stopped.set)
    await stopped.wait()
    server.close()


if __name__ == "__main__":
    asyncio.run(main())
