"""Signals that end a run: what is under way is saved, unless Ctrl-C is pressed again."""

from __future__ import annotations

import asyncio
import os
import signal
import socket
import stat
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager

FROM_TERMINAL = (signal.SIGINT, signal.SIGHUP)
# A query that is about to begin forgets that it was to end.
AGAIN_S = 0.1


@contextmanager
def on_interrupt(first: Callable[[], object], again: Callable[[], object]) -> Iterator[None]:
    """Call ``first`` at the first signal and ``again`` at each later Ctrl-C.

    A terminal that closes sends SIGHUP more than once, often with a SIGTERM. Under nohup SIGHUP
    is ignored, and stays so.
    """
    loop = asyncio.get_running_loop()
    handled = [signal.SIGINT, signal.SIGTERM]
    if signal.getsignal(signal.SIGHUP) is not signal.SIG_IGN:
        handled.append(signal.SIGHUP)
    calls = iter((first,))

    def handle(number: signal.Signals) -> None:
        if number is signal.SIGHUP:
            handled.remove(number)
            loop.remove_signal_handler(number)
            signal.signal(number, signal.SIG_IGN)
            _leave_terminal()
        call = next(calls, again if number is signal.SIGINT else None)
        if call is not None:
            call()

    for number in handled:
        loop.add_signal_handler(number, handle, number)
    try:
        yield
    finally:
        for number in handled:
            loop.remove_signal_handler(number)


def _leave_terminal() -> None:
    """Send the output to nowhere: writing to a closed terminal fails."""
    nowhere = os.open(os.devnull, os.O_WRONLY)
    for stream in (1, 2):
        if stat.S_ISCHR(os.fstat(stream).st_mode):  # isatty is false once it is closed
            os.dup2(nowhere, stream)
    os.close(nowhere)


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
