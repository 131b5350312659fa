"""The list of trials."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from analysis.explorer.catalogue import FACETS, PAGE, SORTS, Filter
from analysis.explorer.site import Site
from analysis.explorer.views import sparkline


def trials_page(site: Site, asked: Mapping[str, str]) -> str:
    """One page of the trials that an address asks for."""
    wanted, sort = filter_of(asked), sort_of(asked)
    totals = site.catalogue.totals(wanted)
    last = max(1, -(-totals.trials // PAGE))
    number = min(page_of(asked), last)
    return site.render(
        "trials.html",
        here="trials",
        facets=site.catalogue.facets(wanted),
        chosen=wanted.chosen,
        cell=asked.get("cell", ""),
        sort=sort,
        sorts=SORTS,
        totals=totals,
        rows=site.catalogue.page(wanted, sort, number),
        page=number,
        last_page=last,
        sparkline=sparkline,
    )


def filter_of(asked: Mapping[str, str]) -> Filter:
    """The filter in an address."""
    given: dict[str, Any] = {name: asked[name] for name in (*FACETS, "q") if name in asked}
    return replace(Filter(), **given)


def sort_of(asked: Mapping[str, str]) -> str:
    """The order in an address; one that is unknown is that of the names."""
    sort = asked.get("sort", "trial")
    return sort if sort.removeprefix("-") in SORTS else "trial"


def page_of(asked: Mapping[str, str]) -> int:
    """The page in an address, from 1."""
    text = asked.get("page", "1")
    return max(1, int(text)) if text.isascii() and text.isdigit() and len(text) < 8 else 1
