"""Handlers of Ctrl-C, SIGTERM and a closing terminal during a run of the command line."""

from __future__ import annotations

import os
import signal
import stat
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType


@contextmanager
def on_signal(stop: Callable[[], object] | None, drop: Callable[[], object]) -> Iterator[None]:
    """Call ``stop`` at the first signal, and ``drop`` at each later Ctrl-C.

    Where there is nothing to stop, the first signal drops. A terminal that closes sends SIGHUP more
    than once, often with a SIGTERM. Under nohup SIGHUP is ignored, and stays so.
    Signals reach the main thread alone: in another one nothing is handled.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    import asyncio

    loop = asyncio.get_running_loop()
    handled = (signal.SIGINT, signal.SIGTERM)
    calls = iter((stop or drop,))

    def handle(number: int) -> None:
        call = next(calls, drop if number == signal.SIGINT else None)
        if call is not None:
            call()

    def hang_up(number: int, _: FrameType | None) -> None:
        # Not by the loop: when it removes a handler, the next signal ends the process.
        signal.signal(number, signal.SIG_IGN)
        _leave_terminal()
        loop.call_soon_threadsafe(handle, number)

    for number in handled:
        loop.add_signal_handler(number, handle, number)
    before = signal.getsignal(signal.SIGHUP)
    if before is not signal.SIG_IGN:
        signal.signal(signal.SIGHUP, hang_up)
    try:
        yield
    finally:
        for number in handled:
            loop.remove_signal_handler(number)
        if signal.getsignal(signal.SIGHUP) is hang_up:
            signal.signal(signal.SIGHUP, before)


def _leave_terminal() -> None:
    """Send the output to nowhere: writing to a closed terminal fails."""
    nowhere = os.open(os.devnull, os.O_WRONLY)
    for stream in (1, 2):
        if stat.S_ISCHR(os.fstat(stream).st_mode):  # isatty is false once it is closed
            os.dup2(nowhere, stream)
    os.close(nowhere)
