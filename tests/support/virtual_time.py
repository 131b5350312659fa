"""Time that passes at once: waits of hours in a test of milliseconds, with real sockets."""

from __future__ import annotations

import asyncio
import functools
import types
from unittest import mock

from asyncio_throttle import throttler

# Loopback delivers at once, but maybe by another thread of the kernel.
PATIENCE_S = 0.002
DAY_S = 86400


class VirtualTimeLoop(asyncio.SelectorEventLoop):
    """Its clock jumps to the next timer when no socket is ready and no thread works for it."""

    def __init__(self):
        self._now_s = 0.0
        self._working = 0
        super().__init__()
        self._wait_for_sockets = self._selector.select
        self._selector.select = self._select

    def time(self):
        return self._now_s

    def run_in_executor(self, *args):
        work = super().run_in_executor(*args)
        self._working += 1
        work.add_done_callback(self._worked)
        return work

    def _worked(self, work):
        self._working -= 1

    def _select(self, timeout=None):
        ready = self._wait_for_sockets(0)
        if ready or timeout == 0:
            return ready
        if timeout is None or self._working:
            return self._wait_for_sockets(None)
        # There is always the loop's own pipe, by which threads wake it.
        if len(self._selector.get_map()) > 1:
            ready = self._wait_for_sockets(PATIENCE_S)
        if not ready:
            self._now_s += timeout
        return ready


def in_virtual_time(test):
    """Run a test in virtual time; whoever would wait for ever waits for a day."""

    async def limited(*args, **kwargs):
        async with asyncio.timeout(DAY_S):
            await test(*args, **kwargs)

    @functools.wraps(test)
    def run(*args, **kwargs):
        # The throttle reads the system's clock, which the clock of a plain loop is, too.
        clock = mock.patch.object(throttler, "time", types.SimpleNamespace(monotonic=now_s))
        with clock, asyncio.Runner(loop_factory=VirtualTimeLoop) as runner:
            runner.run(limited(*args, **kwargs))

    return run


def now_s():
    """The virtual time."""
    return asyncio.get_running_loop().time()


def fullest_window(times, weights, length=60.0):
    """The largest total weight in any window of this length, up to the rounding of its edges."""
    largest = total = first = 0
    for time, weight in zip(times, weights, strict=True):
        total += weight
        while times[first] <= time - length + 1e-9:
            total -= weights[first]
            first += 1
        largest = max(largest, total)
    return largest
