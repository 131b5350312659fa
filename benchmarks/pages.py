"""The floor of the explorer: pages that are made already.

``python -m benchmarks.pages FOLDER`` serves every file of a folder by its name, out of memory, with
the server and the compression of the explorer: nothing is looked up, and no page is written.
"""

from __future__ import annotations

import socket
import sys
from collections.abc import Callable
from pathlib import Path

import uvicorn
from starlette.applications import Starlette
from starlette.middleware import Middleware
from starlette.middleware.gzip import GZipMiddleware
from starlette.requests import Request
from starlette.responses import HTMLResponse, Response
from starlette.routing import Route


def application(folder: Path) -> Starlette:
    """The files of a folder as pages."""
    return Starlette(
        routes=[
            Route(f"/{page.name}", _page(page.read_text("utf-8"))) for page in folder.iterdir()
        ],
        middleware=[Middleware(GZipMiddleware, minimum_size=2_000)],
    )


def _page(text: str) -> Callable[[Request], Response]:
    """It answers in a thread, as the explorer does."""
    return lambda _: HTMLResponse(text)


def main() -> None:
    """Serve until terminated; prints the address."""
    app = application(Path(sys.argv[1]))
    with socket.create_server(("127.0.0.1", 0)) as listener:
        # A page's last part does not wait until the client confirms the first one; asyncio sees to
        # that only where a socket was made with its protocol named.
        listener.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        print(f"http://127.0.0.1:{listener.getsockname()[1]}/", flush=True)
        config = uvicorn.Config(app, log_level="critical", ws="none")
        uvicorn.Server(config).run(sockets=[listener])


if __name__ == "__main__":
    main()
