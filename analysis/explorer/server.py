"""Serves the explorer until it is interrupted."""

from __future__ import annotations

import shutil
import socket
import sys
from collections.abc import Callable
from pathlib import Path

import uvicorn

from merge_runner.errors import UsageError
from merge_runner_analysis.explorer.app import explorer
from merge_runner_analysis.explorer.guard import LOOPBACK
from merge_runner_analysis.explorer.reading import reading
from merge_runner_analysis.explorer.site import Site


def serve(db: Path, port: int, say: Callable[[str], None], reader: str) -> None:
    """Serve a database to a reader; ``say`` gets the address to open. Raises UsageError."""
    site = Site(db, program=_program(), reader=reader)
    with reading(db):
        pass  # what is wrong with it is said at once
    listener = listen(port)
    site.begin()
    say(f"http://{LOOPBACK}:{listener.getsockname()[1]}/")
    config = uvicorn.Config(explorer(site), log_level="critical", ws="none")
    uvicorn.Server(config).run(sockets=[listener])


def _program() -> str:
    """What to type to run this: its path where the shell does not find it, as under ``make``."""
    typed = sys.argv[0]
    plain = Path(typed).name != "merge-runner" or shutil.which("merge-runner") == typed
    return "merge-runner" if plain else typed


def listen(port: int) -> socket.socket:
    """Return a socket that listens at loopback; port 0 takes any free port. Raises UsageError."""
    try:
        listener = socket.create_server((LOOPBACK, port))
    except OSError as exc:
        raise UsageError(
            f"nothing can listen at port {port} of {LOOPBACK} ({exc.strerror}); --port 0 takes a "
            "free port"
        ) from exc
    # asyncio does this for sockets whose protocol is given, and create_server's is not: without it
    # every page waits 40 ms for the browser's delayed acknowledgement of its head.
    listener.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    return listener
