"""The explorer as an application of Starlette: addresses to pages."""

from __future__ import annotations

import logging
import re
from collections.abc import AsyncIterator, Callable, Mapping
from contextlib import asynccontextmanager
from functools import partial
from typing import Any
from urllib.parse import parse_qs

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
from merge_runner_analysis.explorer.assets import STATIC
from merge_runner_analysis.explorer.guard import LOOPBACK, Guard, from_elsewhere
from merge_runner_analysis.explorer.offline import page_of_trials
from merge_runner_analysis.explorer.pages import (
    comparing,
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
from merge_runner_analysis.explorer.site import NothingNew, NotThere, Site

LOG = logging.getLogger(__name__)
# The browser asks for the page again after this many s.
AGAIN = {"refresh": "1"}
FIRST_TIME = (
    "The trials are read for the first time; ten thousand take about ten seconds. This page comes "
    "back by itself."
)
CSV = "text/csv; charset=utf-8"
# What a name of a trial may hold and the name of a file had better not.
FILE_NAME = re.compile(r"[^A-Za-z0-9_.-]+")
MOST_NOTED = 65_536  # bytes of a form with a note
# Nothing in a reply runs, whatever a browser takes it for.
SEALED = {"content-security-policy": "default-src 'none'; sandbox"}
# Matplotlib writes styles into its SVG, and traces as pictures.
DRAWN = {
    "content-security-policy": "default-src 'none'; style-src 'unsafe-inline'; img-src data:; "
    "sandbox"
}


def explorer(site: Site) -> Starlette:
    """Return the application, which answers to names of loopback alone."""

    @asynccontextmanager
    async def lifespan(_: Starlette) -> AsyncIterator[None]:
        yield
        site.close()  # a server that is told to end is killed after this

    return Starlette(
        routes=[
            *_sweep_routes(site),
            *_trial_routes(site),
            *_computed_routes(site),
            *_sql_routes(site),
            *_words_routes(site),
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


def _sweep_routes(site: Site) -> list[Route]:
    page = partial(_page, site)
    one = page(lambda r: sweep.sweep_page(site, r.path_params["sweep"], _seen(r)))
    return [
        Route("/", page(lambda r: home.home_page(site, r.query_params))),
        Route("/drivers", page(lambda r: drivers.drivers_page(site, r.query_params))),
        Route(
            "/drivers/{name:path}",
            page(lambda r: drivers.driver_page(site, r.path_params["name"], r.query_params)),
        ),
        Route("/sweeps", page(lambda r: sweep.sweeps_page(site, r.query_params))),
        Route("/sweeps/{sweep:path}", one),
    ]


def _trial_routes(site: Site) -> list[Route]:
    def export(request: Request) -> Response:
        site.refresh()
        asked = request.query_params
        wanted = trials.export_filter(site, asked)
        content = site.catalogue.export(wanted, trials.sort_of(asked))
        return _download(content, CSV, "trials.csv")

    def raw(request: Request) -> Response:
        text = trial.raw_reply(site, request.path_params["trial"], request.query_params)
        return PlainTextResponse(text, headers=SEALED)

    def others(request: Request) -> Response:
        named = request.path_params["trial"]
        return JSONResponse(comparing.others(site, named, request.query_params))

    def one(request: Request) -> str | Response:
        named, asked = request.path_params["trial"], request.query_params
        if asked.get("as") != "page":
            return trial.trial_page(site, named, asked)
        rows = [trial.find(site, named, asked), comparing.named(site, asked.get("compare", ""))]
        page = page_of_trials(site, [row for row in rows if row is not None])
        return _download(page, "text/html", f"{FILE_NAME.sub('-', named)}.html")

    def fragment(request: Request) -> str:
        return trial.decision_fragment(site, request.path_params["trial"], request.query_params)

    def page_of_all(request: Request) -> Response:
        return RedirectResponse(site.at.to("trials", **request.query_params))

    listing = _page(site, lambda r: trials.trials_page(site, r.query_params))
    return [
        Route("/trials", listing),
        Route("/trials/", page_of_all),
        Route("/trials.csv", export),
        Route("/trials/{trial:path}", _page(site, one)),
        Route("/decisions/{trial:path}", _page(site, fragment)),
        Route("/others/{trial:path}", _page(site, others)),
        Route("/raw/{trial:path}", _page(site, raw)),
    ]


def _computed_routes(site: Site) -> list[Route]:
    def table(request: Request) -> str:
        return tables.table_page(site, request.path_params["name"], request.query_params)

    def file(request: Request) -> Response:
        named = request.path_params["name"], request.path_params["suffix"]
        text, kind = tables.table_file(site, *named)
        return _download(text, kind, ".".join(named))

    def figure(request: Request) -> Response:
        named = request.path_params["name"], request.path_params["form"]
        file = tables.figure_file(site, *named)
        return Response(file, media_type=tables.FORMS[named[1]], headers=DRAWN)

    def figure_page(request: Request) -> str:
        return tables.figure_page(site, request.path_params["name"], request.query_params)

    page = partial(_page, site)
    return [
        Route("/glossary", page(lambda _: site.render("glossary.html", here="glossary"))),
        Route("/tables", page(lambda _: tables.tables_page(site))),
        Route("/tables/{name}.{suffix}", page(file)),
        Route("/figures/{name}.{form}", page(figure)),
        Route("/figures/{name}", page(figure_page)),
        Route("/tables/{name}", page(table)),
        Route("/prompts", page(lambda r: prompts.prompts_page(site, r.query_params))),
        Route("/discordant", page(lambda r: prompts.discordant_page(site, r.query_params))),
    ]


def _download(content: str | bytes, kind: str, name: str) -> Response:
    """A file that a browser saves under this name."""
    headers = {"content-disposition": f'attachment; filename="{name}"'}
    return Response(content, media_type=kind, headers=headers)


def _seen(request: Request) -> str:
    """What a page that looks for news has shown already."""
    return request.query_params.get("seen", "")


def _page(site: Site, render: Callable[[Request], str | Response]) -> Callable[[Request], Response]:
    """A page, of what the database holds now."""

    def answer(request: Request) -> Response:
        if site.beginning:
            return HTMLResponse(_message(site, "Reading the trials", FIRST_TIME), headers=AGAIN)
        site.refresh()
        try:
            rendered = render(request)
        except NothingNew:
            return Response(status_code=204)
        return HTMLResponse(rendered) if isinstance(rendered, str) else rendered

    return answer


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


def _sql_routes(site: Site) -> list[Route]:
    """Only our own pages run a query; where another site leads to one, it is shown and not run."""

    def sql_query(request: Request) -> str:
        run = not from_elsewhere(request.headers)
        return sql.sql_page(site, request.query_params, run=run)

    def sql_download(request: Request) -> Response:
        if from_elsewhere(request.headers):
            return RedirectResponse(site.at.to("sql", q=sql.query_in(request.query_params)))
        try:
            content = sql.sql_csv(site, request.query_params)
        except MergeRunnerError as exc:
            return HTMLResponse(sql.sql_page(site, request.query_params, problem=str(exc)), 400)
        return _download(content, CSV, "query.csv")

    return [Route("/sql", _page(site, sql_query)), Route("/sql.csv", sql_download)]


def _words_routes(site: Site) -> list[Route]:
    """Search in words, and what readers note; see ``Guard`` for who may write."""

    def as_csv(_: Request) -> Response:
        return _download(notes.notes_csv(site), CSV, "notes.csv")

    def write(request: Request, form: Mapping[str, str]) -> Response:
        site.refresh()
        try:
            if "withdraws" in form:
                site.notes.withdraw(form["withdraws"])
                return RedirectResponse(site.at.to("notes"), 303)
            row = notes.add_note(site, form)
        except UsageError as exc:
            return PlainTextResponse(str(exc), 400)
        if "hx-request" in request.headers:
            return HTMLResponse(site.render("_noted.html", row=row))
        return RedirectResponse(site.at.trial(row), 303)

    async def written(request: Request) -> Response:
        body = b""
        async for part in request.stream():
            body += part
            if len(body) > MOST_NOTED:
                return PlainTextResponse("nothing was noted: the form is too large", 413)
        given = parse_qs(body.decode(errors="replace"), max_num_fields=10)
        form = {name: values[-1] for name, values in given.items()}
        return await run_in_threadpool(write, request, form)

    page = partial(_page, site)
    return [
        Route("/words", page(lambda r: words.words_page(site, r.query_params))),
        Route("/notes", page(lambda _: notes.notes_page(site))),
        Route("/notes", written, methods=["POST"]),
        Route("/notes.csv", as_csv),
    ]
