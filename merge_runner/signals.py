"""Ctrl-C: once to stop and save what is under way, twice to drop that too."""

from __future__ import annotations

import asyncio
import signal
import socket
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager

SIGNALS = (signal.SIGINT, signal.SIGTERM)
# A query that is about to begin forgets that it was to end.
AGAIN_S = 0.1


@contextmanager
def on_interrupt(first: Callable[[], object], again: Callable[[], object]) -> Iterator[None]:
    """Call ``first`` at the first signal and ``again`` at each later one."""
    handlers = iter((first,))

    def handle() -> None:
        next(handlers, again)()

    loop = asyncio.get_running_loop()
    for number in SIGNALS:
        loop.add_signal_handler(number, handle)
    try:
        yield
    finally:
        for number in SIGNALS:
            loop.remove_signal_handler(number)


@contextmanager
def at_signals(act: Callable[[], object]) -> Iterator[None]:
    """Call ``act`` from a thread at a signal, although the main thread is not in Python.

    It is called again and again until the block ends. DuckDB looks at no signal while more than one
    of its threads work on a query.
    """
    if threading.current_thread() is not threading.main_thread():
        yield  # signals are the main thread's
        return

    def listen() -> None:
        while _stays_open(heard):
            act()
            heard.settimeout(AGAIN_S)

    heard, told = socket.socketpair()
    told.setblocking(False)
    listener = threading.Thread(target=listen, daemon=True)
    before = signal.set_wakeup_fd(told.fileno())
    listener.start()
    try:
        yield
    finally:
        signal.set_wakeup_fd(before)
        told.close()
        listener.join()
        heard.close()


def _stays_open(heard: socket.socket) -> bool:
    """Wait for a signal, or for as long as the socket waits."""
    try:
        return bool(heard.recv(1))
    except TimeoutError:
        return True
