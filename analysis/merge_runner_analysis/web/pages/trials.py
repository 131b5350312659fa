"""The list of trials, and that of decisions by their words."""

from __future__ import annotations

import re
from collections.abc import Mapping

from starlette.responses import Response

from merge_runner.prompts.blocks import decomposed
from merge_runner.study.arms import OPPONENT
from merge_runner_analysis.tables import TABLES
from merge_runner_analysis.web.listing import FACTOR
from merge_runner_analysis.web.phrases import causes_text, plain
from merge_runner_analysis.web.pictures import speed_range
from merge_runner_analysis.web.reading import Row
from merge_runner_analysis.web.scope import HEADINGS, carried, facets_shown, filter_of, sort_of
from merge_runner_analysis.web.search import FACETS, LIMITS, search, terms_of
from merge_runner_analysis.web.site import NotThere, Site, download, news_of
from merge_runner_analysis.web.trial_index import PAGE, TrialFilter
from merge_runner_analysis.web.urls import CELL, whole

MOST = 4  # drivers whose sums stand above a list
OF_WORDS = HEADINGS | {
    "tactical": "tactical decision",
    "switch": "change of decision",
    "failure": "invalid",
}
# A number from -1 to 1.
LIMIT = re.compile(r"-?(0?\.\d{1,6}|[01](\.0{1,6})?)")


def trials_page(site: Site, params: Mapping[str, str]) -> str:
    """Return a page of the trials in an address; raises NothingNew where it is as ``seen``."""
    state = site.trial_index.state
    seen = news_of(state, params.get("seen", ""))
    news = site.at.to("trials", **{**params, "seen": seen})
    if "seen" in params:  # that the trials are no longer those that were seen
        address = site.at.to("trials", **{**params, "seen": ""})
        return site.render("_news.html", trials=state["trials"], address=address, news=news)
    chosen, sort, cell = filter_of(params), sort_of(params), cell_of(params)
    filters, named = chosen, None
    if cell:
        named = site.computed(cell_request(cell))
        if named.content is None:
            return site.render("behind.html", view="trials", cell=cell["cell"], computed=named)
        filters = {**chosen, "trials": named.content["trials"]}
    totals = site.trial_index.totals(filters)
    trials = sum(part["trials"] for part in totals)
    last = max(1, -(-trials // PAGE))
    page = min(whole(params.get("page", "")) or 1, last)
    rows = site.trial_index.page(filters, sort, page)
    # An export has no filters. Why replies were invalid says whether they were, too.
    facets = {} if site.is_still else facets_shown(site, site.trial_index.facets(filters))
    if not chosen.get("validity"):
        facets.pop("validity", None)
    return site.render(
        "trials.html",
        view="trials",
        facets=facets,
        chosen=chosen,
        headings=HEADINGS,
        carried=carried(params),
        kept={**chosen, **cell},
        cell=cell,
        computed=named,
        sort=sort,
        totals=[row | {"driver": plain(row["model"])} for row in totals if len(totals) <= MOST],
        trials=trials,
        asked=sum(part["asked"] for part in totals),
        invalid=sum(part["invalid"] for part in totals),
        rows=rows,
        errors={row["number"]: causes_text(row["causes"]) for row in rows if row["causes"]},
        # A study's levels of words are among its factors.
        prompted=len({decomposed(row["variant"])[0] for row in rows if row["variant"]}) > 1,
        paired=any(row["ego"] and row["model_left"] != row["model_right"] for row in rows),
        focal=any(row["focal"] for row in rows),
        factors={row["number"]: text for row in rows if (text := _factors(row))},
        scale=speed_range(rows),
        news=news,
        page=page,
        last_page=last,
        unknown=[] if rows else _unknown(site, chosen),
    )


def _factors(row: Row) -> str:
    """Return a trial's levels, without those that its driver's name has."""
    levels = (level for level in row["levels"] or () if level not in row["model"])
    return ", ".join(level for level in levels if not level.startswith(f"{OPPONENT}="))


def _unknown(site: Site, chosen: TrialFilter) -> list[tuple[str, str, list[str]]]:
    """Return facets, by heading, with a chosen value that no trial has, and the known values."""
    known = site.trial_index.facets({})
    return [
        (HEADINGS.get(name, name.removeprefix(FACTOR)), value, [text for text, _ in values])
        for name, value in chosen.items()
        if name != "q" and value not in dict(values := known.get(name, []))
    ]


def trials_csv(site: Site, params: Mapping[str, str]) -> Response:
    """Return the trials in an address as a file; raises NotThere, StoreError and TooMuch."""
    filters: TrialFilter = filter_of(params)
    if cell := cell_of(params):
        filters = {**filters, "trials": site.awaited(cell_request(cell))["trials"]}
    return download(site.trial_index.export(filters, sort_of(params)), "trials.csv")


def cell_of(params: Mapping[str, str]) -> dict[str, str]:
    """Return the cell in an address, with its part of the trials; empty for none."""
    return {name: params[name] for name in CELL if params.get(name)} if params.get("cell") else {}


def cell_request(cell: Mapping[str, str]) -> tuple[str, ...]:
    """Return the request for a cell, ``TABLE/ROW:COLUMN``; raises NotThere."""
    table, _, rest = cell["cell"].partition("/")
    row, _, column = rest.rpartition(":")
    if table not in TABLES or not row:
        raise NotThere(f"a cell is named TABLE/ROW:COLUMN; the tables are {', '.join(TABLES)}")
    _, *part = CELL
    return "cell", table, row, column, *(cell.get(name, "") for name in part)


def words_page(site: Site, params: Mapping[str, str]) -> str:
    """Return a page of the decisions that match an address."""
    query = params.get("q", "")
    filters = filter_of(params) | {name: params.get(name, "") for name in FACETS}
    filters = {name: value for name, value in filters.items() if value and name != "q"}
    limits = {name: text for name in LIMITS if LIMIT.fullmatch(text := params.get(name, ""))}
    chosen = {**filters, **limits, "q": query}
    page = whole(params.get("page", "")) or 1
    result = search(site.trial_index, filters, terms_of(query), limits, page)
    return site.render(
        "words.html",
        view="words",
        headings=OF_WORDS,
        carried=carried(params),
        limits=LIMITS,
        result=result,
        facets=facets_shown(site, result["facets"]),
        chosen=chosen,
        kept=chosen,
    )
