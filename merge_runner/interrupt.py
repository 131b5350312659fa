"""Ctrl-C: once to stop and save what is under way, twice to drop that too."""

from __future__ import annotations

import asyncio
import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager

SIGNALS = (signal.SIGINT, signal.SIGTERM)


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
