"""The explorer as an application of Starlette: addresses to pages."""

from __future__ import annotations

from collections.abc import AsyncIterator, Callable, Collection
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

from starlette.applications import Starlette
from starlette.concurrency import run_in_threadpool
from starlette.exceptions import HTTPException
from starlette.middleware import Middleware
from starlette.middleware.gzip import GZipMiddleware
from starlette.requests import Request
from starlette.responses import (
    HTMLResponse,
    JSONResponse,
    PlainTextResponse,
    RedirectResponse,
    Response,
    StreamingResponse,
)
from starlette.routing import Mount, Route
from starlette.staticfiles import StaticFiles

from analysis.explorer.guard import Guard, from_elsewhere
from analysis.explorer.pages import ablations, humans, sql, sweep, tables, trial, trials
from analysis.explorer.site import NotThere, Site
from merge_runner.errors import MergeRunnerError

STATIC = Path(__file__).with_name("static")
KINDS = {"csv": "text/csv; charset=utf-8", "parquet": "application/vnd.apache.parquet"}
# Nothing in a reply runs, whatever a browser takes it for.
SEALED = {"content-security-policy": "default-src 'none'; sandbox"}


def explorer(site: Site, hosts: Collection[str], token: str | None = None) -> Starlette:
    """The application; see ``Guard`` for who may ask."""

    def page(render: Callable[[Request], str]) -> Callable[[Request], Response]:
        def answer(request: Request) -> Response:
            site.catalogue.refresh()
            return HTMLResponse(render(request))

        return answer

    def may_wait(request: Request) -> dict[str, bool]:
        # A script of ours asks for what a page has said to be on its way.
        return {"patient": request.headers.get("hx-request") == "true"}

    def export(request: Request) -> Response:
        site.catalogue.refresh()
        form = request.path_params["form"]
        if form not in KINDS:
            raise NotThere(f"trials come as {' or '.join(KINDS)}")
        asked = request.query_params
        wanted = trials.export_filter(site, asked)
        content = site.catalogue.export(wanted, trials.sort_of(asked), form)
        name = {"content-disposition": f'attachment; filename="trials.{form}"'}
        return Response(content, media_type=KINDS[form], headers=name)

    def raw(request: Request) -> Response:
        text = trial.raw_reply(site, request.path_params["trial"], request.query_params)
        return PlainTextResponse(text, headers=SEALED)

    def data(request: Request) -> Response:
        return JSONResponse(
            trial.replay_json(site, request.path_params["trial"], request.query_params)
        )

    def home(_: Request) -> Response:
        site.catalogue.refresh()
        return RedirectResponse(sweep.home(site))

    async def events(request: Request) -> Response:
        sweep_id = request.path_params["sweep"]
        await run_in_threadpool(sweep.require_sweep, site, sweep_id)
        # Nothing between us and the browser may hold the stream back.
        plain = {"x-accel-buffering": "no"}
        return StreamingResponse(
            sweep.sweep_events(site, sweep_id), media_type="text/event-stream", headers=plain
        )

    def message(request: Request, exc: Exception) -> Response:
        code = 503 if isinstance(exc, MergeRunnerError) else 404
        heading = "Not there" if code == 404 else "Not now"
        text = f"there is no page {request.url.path}" if isinstance(exc, HTTPException) else exc
        values: dict[str, Any] = {"heading": heading, "text": str(text), "here": ""}
        return HTMLResponse(site.render("message.html", **values), code)

    @asynccontextmanager
    async def lifespan(_: Starlette) -> AsyncIterator[None]:
        yield
        site.close()  # a server that is told to end is killed after this

    of_trial = "{trial:path}"
    return Starlette(
        routes=[
            Route("/", home),
            Route("/sweeps", page(lambda _: sweep.sweeps_page(site))),
            Route("/sweeps/{sweep:path}/events", events),
            Route(
                "/sweeps/{sweep:path}",
                page(lambda r: sweep.sweep_page(site, r.path_params["sweep"])),
            ),
            Route(
                "/trials", page(lambda r: trials.trials_page(site, r.query_params, **may_wait(r)))
            ),
            Route("/trials.{form}", export),
            Route(
                f"/trials/{of_trial}",
                page(lambda r: trial.trial_page(site, r.path_params["trial"], r.query_params)),
            ),
            Route(
                f"/decisions/{of_trial}",
                page(
                    lambda r: trial.decision_fragment(site, r.path_params["trial"], r.query_params)
                ),
            ),
            Route(f"/data/{of_trial}", data),
            Route(f"/raw/{of_trial}", raw),
            *_sql_routes(site),
            Route("/tables", page(lambda _: tables.tables_page(site))),
            Route(
                "/tables/{name}",
                page(
                    lambda r: tables.table_page(
                        site, r.path_params["name"], r.query_params, **may_wait(r)
                    )
                ),
            ),
            Route(
                "/ablations",
                page(lambda r: ablations.ablations_page(site, r.query_params, **may_wait(r))),
            ),
            Route("/discordant", page(lambda r: ablations.discordant_page(site, r.query_params))),
            Route(
                "/humans", page(lambda r: humans.humans_page(site, r.query_params, **may_wait(r)))
            ),
            Mount("/static", StaticFiles(directory=STATIC)),
        ],
        middleware=[
            Middleware(Guard, hosts=hosts, token=token),
            Middleware(GZipMiddleware, minimum_size=2_000),
        ],
        lifespan=lifespan,
        exception_handlers={NotThere: message, MergeRunnerError: message, 404: message},
    )


def _sql_routes(site: Site) -> list[Route]:
    """A query runs for us alone: where another site leads to it, it is shown."""

    def sql_query(request: Request) -> Response:
        run = not from_elsewhere(request.headers)
        return HTMLResponse(sql.sql_page(site, request.query_params, run=run))

    def sql_download(request: Request) -> Response:
        if from_elsewhere(request.headers):
            return RedirectResponse(site.at.to("sql", q=sql.query_in(request.query_params)))
        try:
            content = sql.sql_csv(site, request.query_params)
        except sql.UNANSWERED as exc:
            return HTMLResponse(sql.sql_page(site, request.query_params, problem=str(exc)), 400)
        name = {"content-disposition": 'attachment; filename="query.csv"'}
        return Response(content, media_type=KINDS["csv"], headers=name)

    return [Route("/sql", sql_query), Route("/sql.csv", sql_download)]
