"""Time that passes at once: waits of hours in a test of milliseconds, with real sockets."""

import asyncio
import functools
import types
from unittest import mock

import aiohttp
import pytest
from asyncio_throttle import throttler

# Loopback delivers at once, but maybe by another thread of the kernel.
PATIENCE_S = 0.002
DAY_S = 86400


class VirtualTime:
    """A loop's clock: it jumps to the next timer when no socket is ready and no thread works."""

    def __init__(self, loop):
        self.now_s, self._working = 0.0, 0
        self._sockets, self._wait_for_sockets = loop._selector, loop._selector.select
        self._run_in_executor = loop.run_in_executor
        loop.time, loop.run_in_executor = lambda: self.now_s, self._work
        loop._selector.select = self._select

    def _work(self, *args):
        work = self._run_in_executor(*args)
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
        if len(self._sockets.get_map()) > 1:
            ready = self._wait_for_sockets(PATIENCE_S)
        if not ready:
            self.now_s += timeout
        return ready


def in_virtual_time(test):
    """Run a test in virtual time; whoever would wait for ever waits for a day."""

    async def limited(*args, **kwargs):
        VirtualTime(asyncio.get_running_loop())
        async with asyncio.timeout(DAY_S):
            await test(*args, **kwargs)

    @functools.wraps(test)
    def run(*args, **kwargs):
        with (
            mock.patch.object(throttler, "time", THROTTLE),
            mock.patch.object(aiohttp.connector, "monotonic", now_s),  # idle connections grow old
            asyncio.Runner() as runner,
        ):
            runner.run(limited(*args, **kwargs))

    return run


@pytest.fixture
async def virtual_time(monkeypatch):
    """The same for a test's own loop."""

    def give_up():
        for task in asyncio.all_tasks(loop):
            task.cancel()

    loop = asyncio.get_running_loop()
    VirtualTime(loop)
    monkeypatch.setattr(throttler, "time", THROTTLE)
    day = loop.call_later(DAY_S, give_up)
    yield
    day.cancel()


def now_s():
    """The virtual time."""
    return asyncio.get_running_loop().time()


# The throttle reads the system's clock, which the clock of a plain loop is, too.
THROTTLE = types.SimpleNamespace(monotonic=now_s)


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
