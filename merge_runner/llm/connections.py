"""Connections that carry one answer to each request, and are closed where they carry more."""

from __future__ import annotations

import select
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any

import aiohttp
from aiohttp.client_proto import ResponseHandler

if TYPE_CHECKING:
    from aiohttp.client_reqrep import ConnectionKey
    from aiohttp.connector import Connection
    from aiohttp.tracing import Trace


@dataclass(slots=True)
class Trust:
    """Whether an endpoint has kept to one answer for each request.

    ``doubted`` is True once an answer was late or cut, or something came unasked; ``tied`` while
    its answers name their requests.
    """

    doubted: bool = False
    tied: bool = False

    @property
    def one_each(self) -> bool:
        """Whether a connection serves one request alone, so that nothing late is taken."""
        return self.doubted and not self.tied


class Listener(ResponseHandler):
    """The client's end of a connection, which takes no answer before it has asked."""

    def __init__(self, trust: Trust, **options: Any) -> None:  # noqa: ANN401 # aiohttp's own
        super().__init__(**options)
        self._trust = trust
        self._asked = False

    def start_timeout(self) -> None:
        """The request has been written."""
        self._asked = True
        super().start_timeout()

    def data_received(self, data: bytes) -> None:
        """Pass on what may be an answer; hang up on everything else."""
        if data and not self._asked:
            self._trust.doubted = True
            self.abort()
        else:
            super().data_received(data)

    def fall_silent(self) -> bool:
        """The answer is complete; False if more than that has come with it."""
        self._asked = False
        if len(self) or self._begins_another():
            self._trust.doubted = True
            return False
        return True

    def is_silent(self) -> bool:
        """Whether nothing waits to be read, neither bytes nor the end of the connection."""
        assert self.transport is not None
        # The event loop may have had no time to read what has arrived: so ask the system.
        arrived = select.poll()
        arrived.register(self.transport.get_extra_info("socket").fileno(), select.POLLIN)
        return not arrived.poll(0)

    def _begins_another(self) -> bool:
        """Whether the parser holds the beginning of one more response."""
        if self._parser is None:
            return False
        try:
            # At the end of its input a parser says what it has begun; the next request gets a new
            # parser, so that this one can be spent.
            return self._parser.feed_eof() is not None
        except (aiohttp.http_exceptions.HttpProcessingError, ValueError):
            return True


class Connections(aiohttp.TCPConnector):
    """Keeps connections for the next request only while they are silent."""

    def __init__(self, trust: Trust, **options: Any) -> None:  # noqa: ANN401 # aiohttp's own
        super().__init__(**options)
        self._trust = trust
        self._factory = partial(Listener, trust, loop=self._loop)  # type: ignore[assignment]

    async def _get(self, key: ConnectionKey, traces: list[Trace]) -> Connection | None:
        while (connection := await super()._get(key, traces)) is not None:
            kept = connection.protocol
            assert isinstance(kept, Listener)
            if kept.is_silent() and not self._trust.one_each:
                return connection
            connection.close()
        return None

    def _release(
        self, key: ConnectionKey, protocol: ResponseHandler, *, should_close: bool = False
    ) -> None:
        assert isinstance(protocol, Listener)
        should_close = should_close or not protocol.fall_silent()
        super()._release(key, protocol, should_close=should_close)
