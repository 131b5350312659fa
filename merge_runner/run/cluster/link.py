"""Questions and messages between a worker and the coordinator, over one of Dask's connections.

Messages sent within two milliseconds travel together, so that one packet carries many calls. They
are pickled like everything that Dask carries: anyone who reaches a Dask scheduler can run code
there anyway, so protect the cluster, by TLS where the network is shared.

None of Dask's public primitives does this. An Actor lives on a worker, and the books of the whole
sweep would die with that worker. Asked 500 questions at once, an Actor answered 80 to 180 a second,
and a link 2,600 to 3,900 (on 2 busy cores; a single question took an Actor 1 to 20 ms and a link
12 ms, while a model takes a second). A Semaphore serves whoever asked first, whereas turns and
money go to the oldest trial; and it took 34 s to free what a killed worker held, whereas a closed
connection is noticed at once. Queues, events and topics carry no answers, errors or cancellations.
"""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import Awaitable, Callable, Mapping
from typing import Any

from distributed.batched import BatchedSend
from distributed.comm import Comm, CommClosedError
from distributed.protocol import pickle

from merge_runner import errors
from merge_runner.errors import MergeRunnerError, SweepStopped

# Short beside a call that takes a second, and long enough to gather hundreds of messages.
TOGETHER = "2ms"
ANSWER, ERROR, CANCEL = "answer", "error", "cancel"


class LinkLost(SweepStopped):
    """The other side is gone."""


class Link:
    """One end of a link. ``handlers`` answer what the other end asks or tells, by name.

    When the other side is gone, handlers named in ``survives_disconnect`` still finish; the others
    only wait for something on its behalf, and are cancelled.
    """

    def __init__(
        self,
        comm: Comm,
        handlers: Mapping[str, Callable[..., Any]],
        *,
        survives_disconnect: frozenset[str] = frozenset(),
    ) -> None:
        self._comm = comm
        self._handlers = handlers
        self._survives_disconnect = survives_disconnect
        self._out = BatchedSend(interval=TOGETHER)
        self._out.start(comm)
        self._asked: dict[int, asyncio.Future[Any]] = {}
        self._answering: dict[int, asyncio.Task[None]] = {}
        self._number = 0
        self._broken: BaseException | None = None

    def tell(self, what: str, *content: object) -> None:
        """Send a message that needs no answer; it is lost if the other side is gone."""
        self._send(0, what, content)

    async def ask(self, what: str, *content: object) -> Any:  # noqa: ANN401 # what the handler returns
        """The answer of the other side; raises its MergeRunnerError, or LinkLost."""
        if self._comm.closed():
            raise LinkLost("the other side is gone")
        self._number += 1
        number = self._number
        self._asked[number] = asyncio.get_running_loop().create_future()
        self._send(number, what, content)
        try:
            return await self._asked[number]
        except asyncio.CancelledError:
            # Else the other side would go on waiting, for instance for a turn, on behalf of nobody.
            self._send(number, CANCEL, ())
            raise
        finally:
            del self._asked[number]

    async def serve(self) -> None:
        """Answer until the other side is gone."""
        try:
            while True:
                for message in await self._comm.read():
                    self._hear(*pickle.loads(message))
        except (CommClosedError, OSError):
            pass
        finally:
            self._comm.abort()
            for future in self._asked.values():
                if not future.done():
                    future.set_exception(LinkLost("the other side is gone"))
            for task in self._answering.values():
                if task.get_name() not in self._survives_disconnect:
                    task.cancel()
            # Before serve returns, since then what the other side held is given back.
            await asyncio.gather(*self._answering.values(), return_exceptions=True)
        if self._broken is not None:
            raise self._broken

    async def close(self) -> None:
        """Send what is left and hang up."""
        with contextlib.suppress(CommClosedError, OSError):
            await self._out.close()

    def abort(self) -> None:
        """Hang up at once."""
        self._comm.abort()

    def _send(self, number: int, what: str, content: tuple[object, ...]) -> None:
        with contextlib.suppress(CommClosedError):
            self._out.send(pickle.dumps((number, what, content)))

    def _hear(self, number: int, what: str, content: tuple[Any, ...]) -> None:
        if what in (ANSWER, ERROR):
            self._hear_answer(number, what, content)
        elif what == CANCEL:
            if number in self._answering:
                self._answering[number].cancel()
        elif number == 0:
            self._handlers[what](*content)
        else:
            self._hear_question(number, what, content)

    def _hear_answer(self, number: int, what: str, content: tuple[Any, ...]) -> None:
        future = self._asked.get(number)
        if future is None or future.done():  # whoever asked has given up
            return
        if what == ANSWER:
            future.set_result(content[0])
        else:
            future.set_exception(rebuilt(*content))

    def _hear_question(self, number: int, what: str, content: tuple[Any, ...]) -> None:
        try:
            answer = self._handlers[what](*content)
        except MergeRunnerError as exc:
            self._send(number, ERROR, taken_apart(exc))
            return
        if not isinstance(answer, Awaitable):
            self._send(number, ANSWER, (answer,))
            return
        task = asyncio.create_task(self._answer(number, answer), name=what)
        self._answering[number] = task
        task.add_done_callback(lambda done: self._answered(number, done))

    async def _answer(self, number: int, answer: Awaitable[Any]) -> None:
        try:
            self._send(number, ANSWER, (await answer,))
        except MergeRunnerError as exc:
            self._send(number, ERROR, taken_apart(exc))

    def _answered(self, number: int, done: asyncio.Task[None]) -> None:
        del self._answering[number]
        if not done.cancelled() and (error := done.exception()) is not None:
            self._broken = error  # no error of ours: serve raises it
            self._comm.abort()


def taken_apart(error: MergeRunnerError) -> tuple[str, str]:
    """An error as it travels: its name and its text."""
    return type(error).__name__, str(error)


def rebuilt(name: str, text: str) -> MergeRunnerError:
    """The error that was taken apart."""
    kind = getattr(errors, name, MergeRunnerError)
    error: MergeRunnerError = kind(text)
    return error
