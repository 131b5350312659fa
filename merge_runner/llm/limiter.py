"""Rate limits, requests and tokens a minute; one dispatcher serves the oldest trial first.

asyncio-throttle counts the requests. It polls for every waiter and keeps no order among them, and
it counts a request when it is called. So it is called only where a request can be sent at once: no
pause is on, the limits have room, and no other request waits for the dispatcher. Tokens are counted
in a sliding window of a minute: an estimate at dispatch, the actual usage afterwards. Each process
counts for itself: where several use one key, the server refuses the excess, which is retried.
"""

from __future__ import annotations

import asyncio
import contextlib
import heapq
import itertools
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from math import inf

from asyncio_throttle.throttler import Throttler

from merge_runner.errors import UsageError

WINDOW_S = 60.0
BURST_S = 0.5
CLOCK_STEP_S, POLL_S = 1e-6, 1e-3


@dataclass(order=True, slots=True)
class _Turn:
    """A request in the priority queue; once dispatched, its tokens count in the window."""

    order: int
    arrival: int
    tokens: int = field(compare=False)
    given: asyncio.Future[None] = field(compare=False)
    dispatched_at: float = field(default=-inf, compare=False)


@dataclass(slots=True)
class Pause:
    """End of a pause on the loop's clock, shared by all limiters of one endpoint."""

    until: float = 0.0


class Limiter:
    """Priority queue of turns: lowest ``order`` first, then first come first served.

    The oldest trial goes first so that trials end, and free memory and money. A request whose
    tokens do not fit yet holds back all behind it, so that it never starves behind light ones.
    """

    def __init__(
        self,
        *,
        rpm: int | None = None,
        tpm: int | None = None,
        pause: Pause | None = None,
        window_s: float = WINDOW_S,
        place: str = "models.toml",
    ) -> None:
        """Make a limiter; ``place`` of the model's entry is named where a request never fits."""
        self._place = place
        self._tpm = tpm
        self._window_s = window_s
        self._throttles: list[_Throttle] = []
        if rpm is not None:
            # Half a second's worth goes at a time: a whole window at once would trip finer limits.
            burst = max(1, int(rpm * BURST_S / window_s))
            for rule in ((burst, burst * window_s / rpm), (rpm, window_s)):
                self._throttles.append(_Throttle(*rule, retry_interval=POLL_S))
        self._waiting: list[_Turn] = []
        self._arrivals = itertools.count()
        self._window: deque[_Turn] = deque()
        self._tokens_in_window = 0
        self._pause = pause or Pause()
        self._changed = asyncio.Event()
        self._dispatcher: asyncio.Task[None] | None = None

    async def acquire(self, tokens: int, *, order: int = 0) -> Callable[[int], None] | None:
        """Wait for a turn; ``tokens`` is the estimated usage of the request.

        Where tokens are limited, returns a function that replaces the estimate by the usage.
        """
        if self._tpm is not None and tokens > self._tpm:
            raise UsageError(
                f"one request may use {tokens} tokens, more than the limit of {self._tpm} tokens "
                "a minute: raise --tpm to your account's limit or lower max_output_tokens of "
                + self._place
            )
        loop = asyncio.get_running_loop()
        turn = _Turn(order, next(self._arrivals), tokens, loop.create_future())
        # Where nobody waits and there is room, a dispatcher would only be a further task.
        if not self._waiting and self._blocked_for(turn, loop.time()) <= 0:
            await self._take(turn)
        else:
            turn.given.add_done_callback(lambda _: self._changed.set())
            heapq.heappush(self._waiting, turn)
            self._changed.set()
            if self._dispatcher is None or self._dispatcher.done():
                self._dispatcher = asyncio.create_task(self._dispatch())
            await turn.given
        return None if self._tpm is None else partial(self._correct, turn)

    def pause(self, seconds: float) -> None:
        """Dispatch nothing for a while: the server asked all calls to the endpoint to wait."""
        now = asyncio.get_running_loop().time()
        self._pause.until = max(self._pause.until, now + seconds)

    def _correct(self, turn: _Turn, tokens: int) -> None:
        """Replace the estimate of a turn by the tokens that its request used."""
        if asyncio.get_running_loop().time() - turn.dispatched_at < self._window_s:
            self._tokens_in_window += tokens - turn.tokens
            turn.tokens = tokens
        self._changed.set()

    async def _dispatch(self) -> None:
        loop = asyncio.get_running_loop()
        while self._waiting:
            turn = self._waiting[0]
            # A cancelled request is done before its turn.
            if turn.given.done():
                heapq.heappop(self._waiting)
                continue
            wait = self._blocked_for(turn, loop.time())
            if wait > 0:
                # A new request, or a correction, may change the head of the queue.
                self._changed.clear()
                with contextlib.suppress(TimeoutError):
                    async with asyncio.timeout(wait):
                        await self._changed.wait()
                continue
            heapq.heappop(self._waiting)  # before a wait in which an older trial's may arrive
            await self._take(turn)
            if not turn.given.done():  # it may be cancelled meanwhile
                turn.given.set_result(None)

    async def _take(self, turn: _Turn) -> None:
        """Count a request that can be sent at once."""
        for throttle in self._throttles:
            await throttle.acquire()  # type: ignore[no-untyped-call] # ships no types
        if self._tpm is not None:
            turn.dispatched_at = asyncio.get_running_loop().time()
            self._window.append(turn)
            self._tokens_in_window += turn.tokens

    def _blocked_for(self, turn: _Turn, now: float) -> float:
        """Return the minimum wait in s of the head of the queue."""
        while self._window and now - self._window[0].dispatched_at >= self._window_s:
            self._tokens_in_window -= self._window.popleft().tokens
        free_at = max(self._pause.until, *(throttle.free_at for throttle in self._throttles), 0.0)
        if self._tpm is not None and self._tokens_in_window + turn.tokens > self._tpm:
            # At least until the oldest leaves the window; if that frees too little, once more.
            free_at = max(free_at, self._window[0].dispatched_at + self._window_s)
        return free_at - now


class _Throttle(Throttler):
    """asyncio-throttle that reports when it has room again."""

    @property
    def free_at(self) -> float:
        """Earliest next turn on the event loop's clock, which the throttle uses, too."""
        full = len(self._task_logs) >= self.rate_limit
        # The throttle keeps a turn until more than its period has passed.
        return self._task_logs[0] + self.period + CLOCK_STEP_S if full else 0.0
