"""What drivers said, searched: decisions whose words hold those of a query."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

from merge_runner_analysis.explorer.pages.trials import filter_of
from merge_runner_analysis.explorer.search import (
    KINDS,
    LONGEST,
    LONGEST_QUERY,
    MOST_TERMS,
    OWN_FACETS,
    Wanted,
    terms_of,
)
from merge_runner_analysis.explorer.site import Site
from merge_runner_analysis.explorer.urls import whole

HEADINGS = {
    "tactical": "said",
    "switch": "change of mind",
    "failure": "invalid",
    "model": "driver",
    "variant": "prompt",
}


def words_page(site: Site, asked: Mapping[str, str]) -> str:
    """A page of the decisions that an address asks for."""
    wanted = wanted_of(asked)
    found = site.words.search(wanted, whole(asked.get("page", "")) or 1)
    chosen = {**wanted.trials.chosen, **wanted.own, "q": asked.get("q", "")}
    return site.render(
        "words.html",
        here="words",
        headings=HEADINGS,
        kinds=KINDS,
        longest=LONGEST,
        longest_query=LONGEST_QUERY,
        most_terms=MOST_TERMS,
        found=found,
        facets=found.facets,
        chosen=chosen,
        kind=wanted.kind,
        kept={**chosen, "in": wanted.kind},
    )


def wanted_of(asked: Mapping[str, str]) -> Wanted:
    """What an address asks for; a kind of words that is unknown is the first."""
    own = {name: asked[name] for name in OWN_FACETS if asked.get(name)}
    kind = asked.get("in", "")
    return Wanted(
        kind if kind in KINDS else next(iter(KINDS)),
        terms_of(asked.get("q", "")),
        replace(filter_of(asked), q=""),
        own,
    )
