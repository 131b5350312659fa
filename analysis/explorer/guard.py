"""Who may ask, and what a page may do: a middleware around the whole explorer."""

from __future__ import annotations

import hmac
from collections.abc import Collection
from http.cookies import SimpleCookie
from urllib.parse import parse_qs, urlencode

from starlette.datastructures import Headers, MutableHeaders
from starlette.responses import PlainTextResponse, RedirectResponse
from starlette.types import ASGIApp, Message, Receive, Scope, Send

COOKIE = "merge-runner"
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


def from_elsewhere(headers: Headers) -> bool:
    """Whether another site's page leads here.

    Browsers say so to loopback alone; elsewhere the cookie with the token stays away.
    """
    return headers.get("sec-fetch-site") in {"cross-site", "same-site"}


class Guard:
    """Lets in requests to one of ``hosts`` (``NAME:PORT``) that no other site's page makes.

    With a ``token`` also any other host, for those who know it: from ``?token=`` it goes into a
    cookie. A name that an attacker's server resolves to this machine is no host of ours.
    """

    def __init__(self, app: ASGIApp, hosts: Collection[str], token: str | None = None) -> None:
        self._app = app
        self._hosts = frozenset(hosts)
        self._token = token

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

        refusal = self._refusal(scope)
        if isinstance(refusal, str):
            await PlainTextResponse(refusal + "\n", 403)(scope, receive, guarded)
        elif refusal is not None:
            await refusal(scope, receive, guarded)
        else:
            await self._app(scope, receive, guarded)

    def _refusal(self, scope: Scope) -> str | RedirectResponse | None:
        headers = Headers(scope=scope)
        host = headers.get("host", "")
        if self._token is None and host not in self._hosts:
            return "this host name is not served here"
        origin = headers.get("origin")
        if origin not in {None, f"http://{host}"}:
            return "another site's page may not ask here"
        if from_elsewhere(headers) and headers.get("sec-fetch-mode") != "navigate":
            return "another site's page may not ask here"
        if self._token is None:
            return None
        return self._without_token(scope, headers, self._token)

    @staticmethod
    def _without_token(scope: Scope, headers: Headers, token: str) -> str | RedirectResponse | None:
        cookie = SimpleCookie(headers.get("cookie", "")).get(COOKIE)
        if cookie is not None and hmac.compare_digest(cookie.value, token):
            return None
        query = parse_qs(scope["query_string"].decode(errors="replace"))
        if not hmac.compare_digest(query.pop("token", [""])[0].encode(), token.encode()):
            return "open the address that `merge-runner view` printed, with its token"
        rest = urlencode(query, doseq=True)
        reply = RedirectResponse(scope["path"] + (f"?{rest}" if rest else ""), 303)
        reply.set_cookie(COOKIE, token, httponly=True, samesite="strict")
        return reply
