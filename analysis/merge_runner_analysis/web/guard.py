"""Middleware that refuses other sites' requests and says what a page may do."""

from __future__ import annotations

from starlette.middleware.base import RequestResponseEndpoint
from starlette.requests import Request
from starlette.responses import PlainTextResponse, Response

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


async def guard(request: Request, answer: RequestResponseEndpoint) -> Response:
    """Refuse requests of other sites' pages but links, and add HEADERS to every reply."""
    problem = _problem(request)
    reply = PlainTextResponse(f"{problem}\n", 403) if problem else await answer(request)
    for name, value in HEADERS.items():
        reply.headers.setdefault(name, value)
    return reply


def _problem(request: Request) -> str:
    headers = request.headers
    origin = headers.get("origin")
    # Every browser that shows our pages says whether another site's page led here.
    from_elsewhere = headers.get("sec-fetch-site") in {"cross-site", "same-site"}
    if request.method not in {"GET", "HEAD"} and (origin is None or from_elsewhere):
        return "only a page of the explorer may write here"
    is_link = headers.get("sec-fetch-mode", "navigate") == "navigate"
    followed = is_link and request.url.path not in QUERIES
    is_ours = origin in {None, f"http://{headers.get('host', '')}"}
    if not is_ours or (from_elsewhere and not followed):
        return "another site's page may not ask here"
    return ""
