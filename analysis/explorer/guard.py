"""Who may ask, and what a page may do: a middleware around the whole explorer."""

from __future__ import annotations

import hmac
import ipaddress
import re
from collections.abc import Collection
from urllib.parse import parse_qs, urlencode, urlsplit

from starlette.datastructures import Headers, MutableHeaders
from starlette.responses import PlainTextResponse, RedirectResponse
from starlette.types import ASGIApp, Message, Receive, Scope, Send

# One for each port: a browser sends the cookies of a host to all its ports.
COOKIE = "merge-runner-{port}"
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
    """Whether another site's page led here.

    Over HTTP browsers send ``sec-fetch-site`` to loopback alone, and older ones never: then
    ``origin`` and ``referer`` tell. At other addresses the token is needed, whose cookie is not
    sent from other sites.
    """
    site = headers.get("sec-fetch-site")
    if site is not None:
        return site in {"cross-site", "same-site"}
    host = headers.get("host", "")
    led = [headers[name] for name in ("origin", "referer") if name in headers]
    return any(urlsplit(address).netloc != host for address in led)


def is_address(name: str) -> bool:
    """Whether a host is an IP address and not a name, which any server may resolve to ours."""
    try:
        ipaddress.ip_address(name.removeprefix("[").removesuffix("]"))
    except ValueError:
        return False
    return True


class Guard:
    """Lets in requests to one of ``hosts`` (``NAME:PORT``) that no other site's page makes.

    ``0.0.0.0`` or ``[::]`` among them stands for any IP address. A name that an attacker's server
    resolves to this machine is no host of ours. With a ``token`` only those who know it come in:
    from ``?token=`` it goes into a cookie.
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
        named = host if re.search(r":\d+$", host) else f"{host}:80"  # which browsers leave out
        name, _, port = named.rpartition(":")
        anywhere = {f"0.0.0.0:{port}", f"[::]:{port}"}
        if named not in self._hosts and (self._hosts.isdisjoint(anywhere) or not is_address(name)):
            return "this host name is not served here"
        origin = headers.get("origin")
        if origin not in {None, f"http://{host}"}:
            return "another site's page may not ask here"
        if scope["method"] not in {"GET", "HEAD"} and (origin is None or from_elsewhere(headers)):
            return "only a page of the explorer may write here"
        if from_elsewhere(headers) and headers.get("sec-fetch-mode", "navigate") != "navigate":
            return "another site's page may not ask here"
        if self._token is None:
            return None
        return _without_token(scope, headers, COOKIE.format(port=port), self._token)


def _without_token(
    scope: Scope, headers: Headers, cookie: str, token: str
) -> str | RedirectResponse | None:
    if any(_equal(value, token) for value in _values(headers.get("cookie", ""), cookie)):
        return None
    query = parse_qs(scope["query_string"].decode(errors="replace"))
    if not _equal(query.pop("token", [""])[0], token):
        return "open the address that `merge-runner view` printed, with its token"
    rest = urlencode(query, doseq=True)
    reply = RedirectResponse(scope["path"] + (f"?{rest}" if rest else ""), 303)
    reply.set_cookie(cookie, token, httponly=True, samesite="strict")
    return reply


def _values(cookies: str, name: str) -> list[str]:
    """What a cookie holds; no parser of cookies takes all that other programs write into theirs."""
    pairs = [cookie.strip().partition("=") for cookie in cookies.split(";")]
    return [value for key, _, value in pairs if key == name]


def _equal(given: str, token: str) -> bool:
    # In a time that does not tell how much of a guess is right.
    return hmac.compare_digest(given.encode(), token.encode())
