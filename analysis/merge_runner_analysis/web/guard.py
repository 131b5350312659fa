"""Middleware that refuses other sites' requests and says what a page may do."""

from __future__ import annotations

from starlette.datastructures import Headers, MutableHeaders
from starlette.responses import PlainTextResponse
from starlette.types import ASGIApp, Message, Receive, Scope, Send

LOOPBACK = "127.0.0.1"
QUERIES = {"/sql", "/sql.csv"}  # where a link alone would run something
# Scripts and styles are files of ours. What a model wrote could not run even if it were let in.
POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data:; "
    "connect-src 'self'; form-action 'self'; base-uri 'none'; frame-ancestors 'none'"
)
HEADERS = {
    "content-security-policy": POLICY,
    "x-content-type-options": "nosniff",
    "referrer-policy": "same-origin",
    "cross-origin-opener-policy": "same-origin",
    "cross-origin-resource-policy": "same-origin",
    "cache-control": "no-store",
}


class Guard:
    """Refuses requests of other sites' pages but links, and adds HEADERS to every reply."""

    def __init__(self, app: ASGIApp) -> None:
        self._app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer, or say why not."""
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return

        async def guarded(message: Message) -> None:
            if message["type"] == "http.response.start":
                headers = MutableHeaders(scope=message)
                for name, value in HEADERS.items():
                    headers.setdefault(name, value)
            await send(message)

        problem = _problem(scope["method"], scope["path"], Headers(scope=scope))
        app = PlainTextResponse(f"{problem}\n", 403) if problem else self._app
        await app(scope, receive, guarded)


def _problem(method: str, path: str, headers: Headers) -> str:
    origin = headers.get("origin")
    # Every browser that shows our pages says whether another site's page led here.
    from_elsewhere = headers.get("sec-fetch-site") in {"cross-site", "same-site"}
    if method not in {"GET", "HEAD"} and (origin is None or from_elsewhere):
        return "only a page of the explorer may write here"
    followed = headers.get("sec-fetch-mode", "navigate") == "navigate" and path not in QUERIES
    is_ours = origin in {None, f"http://{headers.get('host', '')}"}
    if not is_ours or (from_elsewhere and not followed):
        return "another site's page may not ask here"
    return ""
