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


def serve(db: Path, port: int, bind: str, say: Callable[[str], None]) -> None:
    """Serve a database; ``say`` is told the address. Raises UsageError."""
    site = Site(db, program=_program())
    with reading(db):
        pass  # what is wrong with it is said at once
    site.begin()
    listener = listen(bind, port)
    port = listener.getsockname()[1]
    token = None if bind == LOOPBACK else secrets.token_urlsafe(24)
    hosts = {f"{LOOPBACK}:{port}", f"localhost:{port}"}
    shown = LOOPBACK if bind == "0.0.0.0" else bind  # noqa: S104 # compared, not bound
    say(f"http://{shown}:{port}/" + (f"?token={token}" if token else ""))
    config = uvicorn.Config(explorer(site, hosts, token), log_level="critical", ws="none")
    _Server(config, site).run(sockets=[listener])


def _program() -> str:
    """What was typed to run this, by ``make`` too: the shell may not find the program elsewhere."""
    typed = sys.argv[0]
    found = Path(typed).name != "merge-runner" or shutil.which("merge-runner") == typed
    return "merge-runner" if found else typed


class _Server(uvicorn.Server):
    """One that ends the streams when it ends: it waits for its connections otherwise."""

    def __init__(self, config: uvicorn.Config, site: Site) -> None:
        super().__init__(config)
        self._site = site

    async def shutdown(self, sockets: list[socket.socket] | None = None) -> None:
        """Stop serving."""
        self._site.closing = True
        await super().shutdown(sockets)


def listen(bind: str, port: int) -> socket.socket:
    """A socket that listens, 0: at any free port; raises UsageError."""
    try:
        return socket.create_server((bind, port))
    except OSError as exc:
        raise UsageError(
            f"nothing can listen at {bind}:{port} ({exc.strerror}); --port 0 takes a free port"
        ) from exc
