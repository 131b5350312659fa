"""The explorer as an application of Starlette: addresses to pages, and how it is served."""

from __future__ import annotations

import logging
import shutil
import socket
import sys
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from functools import partial
from pathlib import Path
from typing import Any
from urllib.parse import parse_qsl, quote

import uvicorn
from starlette.applications import Starlette
from starlette.concurrency import run_in_threadpool
from starlette.datastructures import MutableHeaders
from starlette.exceptions import HTTPException
from starlette.middleware import Middleware
from starlette.middleware.gzip import GZipMiddleware
from starlette.middleware.trustedhost import TrustedHostMiddleware
from starlette.requests import ClientDisconnect, Request
from starlette.responses import (
    HTMLResponse,
    JSONResponse,
    PlainTextResponse,
    RedirectResponse,
    Response,
)
from starlette.routing import Mount, Route
from starlette.staticfiles import StaticFiles
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from merge_runner.errors import MergeRunnerError, UsageError
from merge_runner_analysis.web.glossary import sections
from merge_runner_analysis.web.pages import (
    conditions,
    drivers,
    home,
    prompts,
    sql,
    sweep,
    tables,
    trial,
    trials,
)
from merge_runner_analysis.web.reading import reading
from merge_runner_analysis.web.rendering import STATIC
from merge_runner_analysis.web.site import NothingNew, NotThere, Site, TooMuch
from merge_runner_analysis.web.urls import whole

# Names that a reader may type, of the pages that are called otherwise.
_PLURALS = ("drivers", "trials", "conditions", "sweeps", "prompts", "words", "notes", "tables")
ALIASES = {
    **dict.fromkeys(("home", "study", "index", "conditions"), ""),
    **{name.removesuffix("s"): name for name in (*_PLURALS, "figures")},
    "run": "sweeps",
    "runs": "sweeps",
    "figures": "tables",
}
LOG = logging.getLogger(__name__)
FIRST_TIME = (
    "The trials are read for the first time; ten thousand take about two seconds. This page comes "
    "back by itself."
)
MOST_NOTED, MOST_FIELDS = 65_536, 10  # bytes and fields of a form with a note
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


def serve(db: Path, port: int, say: Callable[[str], None], reader: str, study: str) -> None:
    """Serve a database to a reader; ``say`` gets the address to open. Raises UsageError.

    ``study`` is the file of the study whose parts are in use, empty without one.
    """
    typed = sys.argv[0]
    # The command that runs this: a path where the shell does not find it, as under ``make``.
    plain = Path(typed).name != "merge-runner" or shutil.which("merge-runner") == typed
    site = Site(db, program="merge-runner" if plain else typed, reader=reader, study=study)
    with reading(db):
        pass  # what is wrong with it is said at once
    listener = listen(port)
    site.begin()
    say(f"http://{LOOPBACK}:{listener.getsockname()[1]}/")
    config = uvicorn.Config(explorer(site), log_level="critical", ws="none")
    uvicorn.Server(config).run(sockets=[listener])


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


def explorer(site: Site) -> Starlette:
    """Return the application, which answers to names of loopback alone."""

    @asynccontextmanager
    async def lifespan(_: Starlette) -> AsyncIterator[None]:
        yield
        site.computing.close()  # a server that gets a signal to end is killed after this

    return Starlette(
        routes=[
            *(Route(path, partial(_page, site, render)) for path, render in PAGES.items()),
            *(Route(f"/{alias}", _redirect) for alias in ALIASES),
            *(Route(f"/{alias}/{{name:path}}", _redirect) for alias, to in ALIASES.items() if to),
            Route("/notes", partial(_noted, site), methods=["POST"]),
            Mount("/static", StaticFiles(directory=STATIC)),
        ],
        middleware=[
            Middleware(guard),
            Middleware(TrustedHostMiddleware, allowed_hosts=[LOOPBACK, "localhost"]),
            Middleware(GZipMiddleware, minimum_size=2_000),
        ],
        lifespan=lifespan,
        exception_handlers=_errors(site),
    )


def _page(site: Site, render: Callable[..., str | Response], request: Request) -> Response:
    if site.beginning:
        text = site.render("message.html", heading="Reading the trials", text=FIRST_TIME, view="")
        return HTMLResponse(text, headers={"refresh": "1"})  # in s
    site.refresh()
    rendered = render(site, *request.path_params.values(), request.query_params)
    return HTMLResponse(rendered) if isinstance(rendered, str) else rendered


def _redirect(request: Request) -> Response:
    """Lead from a name that a reader may type to the page, which keeps the rest of the address."""
    typed, _, name = request.scope["path"].removeprefix("/").partition("/")
    page = "/".join(filter(None, (ALIASES[typed], name)))
    return RedirectResponse(
        f"/{quote(page)}" + (f"?{request.url.query}" if request.url.query else "")
    )


# Functions that render the pages, from the names and the query of an address.
PAGES: dict[str, Callable[..., str | Response]] = {
    "/": home.home_page,
    "/drivers": drivers.drivers_page,
    "/drivers/{name:path}": drivers.driver_page,
    "/conditions/{name:path}": conditions.condition_page,
    "/sweeps": sweep.sweeps_page,
    "/sweeps/{name:path}": sweep.sweep_page,
    "/trials": trials.trials_page,
    "/trials/": lambda site, params: RedirectResponse(site.at.to("trials", **params)),
    "/trials.csv": trials.trials_csv,
    "/trials/{name:path}": trial.trial_page,
    "/others/{name:path}": lambda *given: JSONResponse(trial.others(*given)),
    "/glossary": lambda site, _: site.render("glossary.html", view="glossary", glossary=sections()),
    "/tables": tables.tables_page,
    "/tables/{name}.{suffix}": tables.table_file,
    "/tables/{name}": tables.table_page,
    "/figures/{name}.{suffix}": tables.figure_file,
    "/figures/{name}": tables.figure_page,
    "/cite": tables.cite_page,
    "/prompts": prompts.prompts_page,
    "/discordant": prompts.discordant_page,
    "/words": trials.words_page,
    "/notes": trial.notes_page,
    "/sql": sql.sql_page,
    "/sql.csv": sql.sql_csv,
}


async def _noted(site: Site, request: Request) -> Response:
    """Keep what a reader notes; see ``guard`` for who may write."""
    size = whole(request.headers.get("content-length", ""))
    if size is None or size > MOST_NOTED:
        return PlainTextResponse("nothing was noted: the form is too large", 413)
    body = (await request.body()).decode(errors="replace")

    def write() -> Response:
        site.refresh()
        try:
            row = trial.add_note(site, dict(parse_qsl(body, max_num_fields=MOST_FIELDS)))
        except (UsageError, ValueError) as exc:
            return PlainTextResponse(str(exc), 400)
        return RedirectResponse(site.at.trial(row), 303)

    return await run_in_threadpool(write)


def guard(app: ASGIApp) -> ASGIApp:
    """Refuse requests of other sites' pages but links, and add HEADERS to every reply."""

    async def guarded(scope: Scope, receive: Receive, send: Send) -> None:
        async def send_with_headers(message: Message) -> None:
            if message["type"] == "http.response.start":
                headers = MutableHeaders(scope=message)
                for name, value in HEADERS.items():
                    headers.setdefault(name, value)
            await send(message)

        problem = _problem(Request(scope)) if scope["type"] == "http" else ""
        answer = PlainTextResponse(f"{problem}\n", 403) if problem else app
        await answer(scope, receive, send_with_headers)

    return guarded


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


def _errors(site: Site) -> dict[Any, Callable[[Request, Exception], Response]]:

    def error_page(heading: str, code: int, request: Request, exc: Exception) -> Response:
        text = str(exc)
        if isinstance(exc, HTTPException):
            text = f"there is no page {request.url.path}"
        if code == 500:
            LOG.error("%s: a fault of the explorer: %r", request.url.path, exc)
            LOG.debug("where it happened", exc_info=exc)
            text = f"A fault of the explorer: {exc!r}. The other pages go on."
        return HTMLResponse(site.render("message.html", heading=heading, text=text, view=""), code)

    return {
        NothingNew: lambda *_: Response(status_code=204),
        NotThere: partial(error_page, "Not there", 404),
        TooMuch: partial(error_page, "Too much", 400),
        # Nobody reads an answer to a browser that has left.
        ClientDisconnect: lambda *_: Response(status_code=400),
        404: partial(error_page, "Not there", 404),
        MergeRunnerError: partial(error_page, "Not now", 503),
        Exception: partial(error_page, "A fault", 500),
    }
