"""The list of trials."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from merge_runner_analysis.explorer.catalogue import FACETS, FACTOR, PAGE, SORTS, Filter
from merge_runner_analysis.explorer.pages.computed import awaited, computed
from merge_runner_analysis.explorer.pictures import sparkline, speed_range
from merge_runner_analysis.explorer.scope import carried
from merge_runner_analysis.explorer.site import NotThere, Site, news_of
from merge_runner_analysis.explorer.urls import whole
from merge_runner_analysis.tables import TABLES

# What facets are called that have another name in an address.
HEADINGS = {"sweep": "run", "model": "driver", "variant": "prompt"}


def trials_page(site: Site, asked: Mapping[str, str]) -> str:
    """One page of the trials that an address asks for; raises NothingNew as it was ``seen``."""
    state = site.catalogue.state()
    seen = news_of(state, asked.get("seen", ""))
    if "seen" in asked:  # that the trials are no longer those that were seen
        here, news = (at_of(site, asked, seen=text) for text in ("", seen))
        return site.render("_news.html", trials=state[0], here=here, news=news)
    wanted, sort = filter_of(asked), sort_of(asked)
    cell, named = asked.get("cell", ""), None
    if cell:
        named = computed(site, cell_request(cell))
        if named.content is None:
            return site.render("behind.html", here="trials", cell=cell, computed=named)
        wanted = replace(wanted, trials=tuple(named.content["trials"]))
    totals = site.catalogue.totals(wanted)
    trials = sum(part["trials"] for part in totals.values())
    last = max(1, -(-trials // PAGE))
    number = min(page_of(asked), last)
    rows = site.catalogue.page(wanted, sort, number)
    facets = site.catalogue.facets(wanted)
    return site.render(
        "trials.html",
        here="trials",
        facets=facets,
        chosen=wanted.chosen,
        headings=HEADINGS,
        carried=carried(asked),
        kept={**wanted.chosen, "cell": cell},
        cell=cell,
        computed=named,
        sort=sort,
        sorts=SORTS,
        totals=totals,
        trials=trials,
        rows=rows,
        leveled=any(row["levels"] for row in rows),
        scale=speed_range(rows),
        news=at_of(site, asked, seen=seen),
        page=number,
        last_page=last,
        sparkline=sparkline,
    )


def at_of(site: Site, asked: Mapping[str, str], **state: str) -> str:
    """The address of a list, with more of a state."""
    return site.at.to("trials", **{**asked, **state})


def export_filter(site: Site, asked: Mapping[str, str]) -> Filter:
    """The filter in an address, whose cell may have to be computed; raises NotThere, StoreError."""
    wanted, cell = filter_of(asked), asked.get("cell", "")
    if not cell:
        return wanted
    found = awaited(site, cell_request(cell))
    return replace(wanted, trials=tuple(found["trials"]))


def cell_request(cell: str) -> tuple[str, str, str, str]:
    """What is asked for a cell, ``TABLE/ROW:COLUMN``; raises NotThere."""
    table, _, rest = cell.partition("/")
    row, _, column = rest.rpartition(":")
    if table not in TABLES or not row:
        raise NotThere(f"a cell is named TABLE/ROW:COLUMN; the tables are {', '.join(TABLES)}")
    return "cell", table, row, column


def filter_of(asked: Mapping[str, str]) -> Filter:
    """The filter in an address."""
    given: dict[str, Any] = {name: asked[name] for name in (*FACETS, "q") if name in asked}
    levels = [
        (name.removeprefix(FACTOR), level)
        for name, level in asked.items()
        if name.startswith(FACTOR) and level
    ]
    return replace(Filter(), **given, levels=tuple(levels))


def sort_of(asked: Mapping[str, str]) -> str:
    """The order in an address; one that is unknown is that of the names."""
    sort = asked.get("sort", "trial")
    return sort if sort.removeprefix("-") in SORTS else "trial"


def page_of(asked: Mapping[str, str]) -> int:
    """The page in an address, from 1."""
    return whole(asked.get("page", "")) or 1
