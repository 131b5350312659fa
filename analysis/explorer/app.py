"""The explorer as an application of Starlette: addresses to pages, and how it is served."""

from __future__ import annotations

import logging
import re
import shutil
import socket
import sys
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from functools import partial
from pathlib import Path
from typing import Any
from urllib.parse import parse_qsl

import uvicorn
from starlette.applications import Starlette
from starlette.concurrency import run_in_threadpool
from starlette.middleware import Middleware
from starlette.middleware.gzip import GZipMiddleware
from starlette.middleware.trustedhost import TrustedHostMiddleware
from starlette.requests import Request
from starlette.responses import (
    HTMLResponse,
    JSONResponse,
    PlainTextResponse,
    RedirectResponse,
    Response,
)
from starlette.routing import Mount, Route
from starlette.staticfiles import StaticFiles

from merge_runner.errors import MergeRunnerError, UsageError
from merge_runner_analysis.explorer.guard import LOOPBACK, Guard, from_elsewhere
from merge_runner_analysis.explorer.offline import page_of_trials
from merge_runner_analysis.explorer.pages import (
    conditions,
    drivers,
    home,
    notes,
    prompts,
    sql,
    sweep,
    tables,
    trial,
    trials,
    words,
)
from merge_runner_analysis.explorer.reading import reading
from merge_runner_analysis.explorer.site import STATIC, NothingNew, NotThere, Site
from merge_runner_analysis.explorer.urls import whole

LOG = logging.getLogger(__name__)
FIRST_TIME = (
    "The trials are read for the first time; ten thousand take about ten seconds. This page comes "
    "back by itself."
)
CSV = "text/csv; charset=utf-8"
# What a name of a trial may hold and the name of a file had better not.
FILE_NAME = re.compile(r"[^A-Za-z0-9_.-]+")
MOST_NOTED, MOST_FIELDS = 65_536, 10  # bytes and fields of a form with a note
# Nothing in a reply runs, whatever a browser takes it for.
SEALED = {"content-security-policy": "default-src 'none'; sandbox"}
# Matplotlib writes styles into its SVG, and traces as pictures.
DRAWN = {
    "content-security-policy": "default-src 'none'; style-src 'unsafe-inline'; img-src data:; "
    "sandbox"
}


def serve(db: Path, port: int, say: Callable[[str], None], reader: str) -> None:
    """Serve a database to a reader; ``say`` gets the address to open. Raises UsageError."""
    typed = sys.argv[0]
    # What to type to run this: its path where the shell does not find it, as under ``make``.
    plain = Path(typed).name != "merge-runner" or shutil.which("merge-runner") == typed
    site = Site(db, program="merge-runner" if plain else typed, reader=reader)
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
        site.close()  # a server that is told to end is killed after this

    return Starlette(
        routes=[
            *(Route(path, partial(_page, site, render)) for path, render in PAGES.items()),
            Route("/notes", partial(_noted, site), methods=["POST"]),
            Mount("/static", StaticFiles(directory=STATIC)),
        ],
        middleware=[
            Middleware(Guard),
            Middleware(TrustedHostMiddleware, allowed_hosts=[LOOPBACK, "localhost"]),
            Middleware(GZipMiddleware, minimum_size=2_000),
        ],
        lifespan=lifespan,
        exception_handlers=_errors(site),
    )


def _page(
    site: Site, render: Callable[[Site, Request], str | Response], asked: Request
) -> Response:
    """A page, of what the database holds now."""
    if site.beginning:
        text = _message(site, "Reading the trials", FIRST_TIME)
        return HTMLResponse(text, headers={"refresh": "1"})  # in s
    site.refresh()
    try:
        rendered = render(site, asked)
    except NothingNew:
        return Response(status_code=204)
    return HTMLResponse(rendered) if isinstance(rendered, str) else rendered


def _shown(render: Callable[..., str]) -> Callable[[Site, Request], str]:
    """The page of what an address names and asks for."""
    return lambda site, asked: render(site, *asked.path_params.values(), asked.query_params)


def _trial(site: Site, asked: Request) -> str | Response:
    name, state = asked.path_params["name"], asked.query_params
    if state.get("as") != "page":
        return trial.trial_page(site, name, state)
    rows = [trial.find(site, name, state), trial.named(site, state.get("compare", ""))]
    page = page_of_trials(site, [row for row in rows if row is not None])
    return _download(page, "text/html", f"{FILE_NAME.sub('-', name)}.html")


def _others(site: Site, asked: Request) -> Response:
    return JSONResponse(trial.others(site, asked.path_params["name"], asked.query_params))


def _raw(site: Site, asked: Request) -> Response:
    text = trial.raw_reply(site, asked.path_params["name"], asked.query_params)
    return PlainTextResponse(text, headers=SEALED)


def _trials_csv(site: Site, asked: Request) -> Response:
    wanted = trials.export_filter(site, asked.query_params)
    content = site.catalogue.export(wanted, trials.sort_of(asked.query_params))
    return _download(content, CSV, "trials.csv")


def _table_file(site: Site, asked: Request) -> Response:
    name, suffix = asked.path_params["name"], asked.path_params["suffix"]
    text, kind = tables.table_file(site, name, suffix)
    return _download(text, kind, f"{name}.{suffix}")


def _figure_file(site: Site, asked: Request) -> Response:
    name, form = asked.path_params["name"], asked.path_params["form"]
    file = tables.figure_file(site, name, form)
    return Response(file, media_type=tables.FORMS[form], headers=DRAWN)


def _sql(site: Site, asked: Request) -> str:
    """Only our own pages run a query; where another site leads to one, it is shown and not run."""
    return sql.sql_page(site, asked.query_params, run=not from_elsewhere(asked.headers))


def _sql_csv(site: Site, asked: Request) -> Response:
    state = asked.query_params
    if from_elsewhere(asked.headers):
        return RedirectResponse(site.at.to("sql", q=sql.query_in(state)))
    try:
        return _download(site.queries.csv(sql.query_in(state)), CSV, "query.csv")
    except MergeRunnerError as exc:
        return HTMLResponse(sql.sql_page(site, state, problem=str(exc)), 400)


PAGES: dict[str, Callable[[Site, Request], str | Response]] = {
    "/": _shown(home.home_page),
    "/drivers": _shown(drivers.drivers_page),
    "/drivers/{name:path}": _shown(drivers.driver_page),
    "/conditions/{name:path}": _shown(conditions.condition_page),
    "/sweeps": _shown(sweep.sweeps_page),
    "/sweeps/{name:path}": _shown(sweep.sweep_page),
    "/trials": _shown(trials.trials_page),
    "/trials/": lambda site, asked: RedirectResponse(site.at.to("trials", **asked.query_params)),
    "/trials.csv": _trials_csv,
    "/trials/{name:path}": _trial,
    "/decisions/{name:path}": _shown(trial.decision_fragment),
    "/others/{name:path}": _others,
    "/raw/{name:path}": _raw,
    "/glossary": lambda site, _: site.render("glossary.html", here="glossary"),
    "/tables": lambda site, _: tables.tables_page(site),
    "/tables/{name}.{suffix}": _table_file,
    "/tables/{name}": _shown(tables.table_page),
    "/figures/{name}.{form}": _figure_file,
    "/figures/{name}": _shown(tables.figure_page),
    "/prompts": _shown(prompts.prompts_page),
    "/discordant": _shown(prompts.discordant_page),
    "/words": _shown(words.words_page),
    "/notes": lambda site, _: notes.notes_page(site),
    "/sql": _sql,
    "/sql.csv": _sql_csv,
}


async def _noted(site: Site, request: Request) -> Response:
    """Keep what a reader notes; see ``Guard`` for who may write."""
    size = whole(request.headers.get("content-length", ""))
    if size is None or size > MOST_NOTED:
        return PlainTextResponse("nothing was noted: the form is too large", 413)
    body = await request.body()

    def write() -> Response:
        site.refresh()
        try:
            fields = parse_qsl(body.decode(errors="replace"), max_num_fields=MOST_FIELDS)
            row = notes.add_note(site, dict(fields))
        except (UsageError, ValueError) as exc:
            return PlainTextResponse(str(exc), 400)
        if "hx-request" in request.headers:
            return HTMLResponse(site.render("_noted.html", row=row))
        return RedirectResponse(site.at.trial(row), 303)

    return await run_in_threadpool(write)


def _download(content: str | bytes, kind: str, name: str) -> Response:
    """A file that a browser saves under this name."""
    headers = {"content-disposition": f'attachment; filename="{name}"'}
    return Response(content, media_type=kind, headers=headers)


def _message(site: Site, heading: str, text: str) -> str:
    return site.render("message.html", heading=heading, text=text, here="")


def _errors(site: Site) -> dict[Any, Callable[[Request, Exception], Response]]:
    """The pages that say why there is no other."""

    def said(heading: str, text: str, code: int) -> Response:
        return HTMLResponse(_message(site, heading, text), code)

    def absent(_: Request, exc: Exception) -> Response:
        reply = said("Not there", str(exc), 404)
        reply.headers["hx-refresh"] = "true"  # a page that waited for it is loaded anew, to say so
        return reply

    def fault(request: Request, exc: Exception) -> Response:
        LOG.error("%s: a fault of the explorer: %r", request.url.path, exc)
        LOG.debug("where it happened", exc_info=exc)
        return said("A fault", f"A fault of the explorer: {exc!r}. The other pages go on.", 500)

    return {
        NotThere: absent,
        404: lambda request, _: said("Not there", f"there is no page {request.url.path}", 404),
        MergeRunnerError: lambda _, exc: said("Not now", str(exc), 503),
        Exception: fault,
    }
