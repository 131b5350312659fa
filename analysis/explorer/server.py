"""Serves the explorer until it is interrupted."""

from __future__ import annotations

import secrets
import shutil
import socket
import sys
from collections.abc import Callable
from pathlib import Path

import uvicorn

from analysis.explorer.app import explorer
from analysis.explorer.reading import reading
from analysis.explorer.site import Site
from merge_runner.errors import UsageError

LOOPBACK = "127.0.0.1"
# A server at all addresses is at this one, too.
EVERYWHERE = {"0.0.0.0": LOOPBACK, "::": "::1"}  # noqa: S104 # compared, not bound


def serve(db: Path, port: int, bind: str, say: Callable[[str], None], reader: str) -> None:
    """Serve a database to a reader; ``say`` gets the address to open. Raises UsageError."""
    site = Site(db, program=_program(), reader=reader)
    with reading(db):
        pass  # what is wrong with it is said at once
    listener = listen(bind, port)
    site.begin()
    address, port = listener.getsockname()[:2]
    token = None if bind == LOOPBACK else secrets.token_urlsafe(24)
    hosts = [f"{name}:{port}" for name in names_of(bind, address)]
    say(f"http://{hosts[0]}/" + (f"?token={token}" if token else ""))
    config = uvicorn.Config(explorer(site, hosts, token), log_level="critical", ws="none")
    uvicorn.Server(config).run(sockets=[listener])


def names_of(bind: str, address: str) -> list[str]:
    """The names by which a browser may reach ``address``, bound as ``bind``; the first is shown."""
    reached = EVERYWHERE.get(address, address)
    names = [bind if reached == address else reached, address]
    if reached in EVERYWHERE.values():
        names.append("localhost")
    if reached != address:
        names += [socket.gethostname(), socket.getfqdn()]
    return [f"[{name}]" if ":" in name else name for name in map(str.lower, names)]


def _program() -> str:
    """What to type to run this: its path where the shell does not find it, as under ``make``."""
    typed = sys.argv[0]
    plain = Path(typed).name != "merge-runner" or shutil.which("merge-runner") == typed
    return "merge-runner" if plain else typed


def listen(bind: str, port: int) -> socket.socket:
    """A listening socket; port 0 takes any free port. Raises UsageError."""
    family = socket.AF_INET6 if ":" in bind else socket.AF_INET
    try:
        listener = socket.create_server((bind, port), family=family)
    except OSError as exc:
        raise UsageError(
            f"nothing can listen at port {port} of {bind} ({exc.strerror}); --port 0 takes a free "
            "port, --bind needs an address of this machine"
        ) from exc
    # asyncio does this for sockets whose protocol is given, and create_server's is not: without it
    # every page waits 40 ms for the browser's delayed acknowledgement of its head.
    listener.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    return listener
