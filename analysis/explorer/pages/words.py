"""What drivers said, searched: decisions whose words hold those of a query."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import replace

from merge_runner_analysis.explorer.pages import trials
from merge_runner_analysis.explorer.scope import carried
from merge_runner_analysis.explorer.search import (
    KINDS,
    LIMITS,
    OWN_FACETS,
    Wanted,
    terms_of,
)
from merge_runner_analysis.explorer.site import Site
from merge_runner_analysis.explorer.urls import whole

HEADINGS = trials.HEADINGS | {
    "tactical": "said",
    "switch": "change of mind",
    "failure": "invalid",
}

LIMIT = re.compile(r"-?(0?\.\d{1,6}|[01](\.0{1,6})?)")


def words_page(site: Site, asked: Mapping[str, str]) -> str:
    """A page of the decisions that an address asks for."""
    wanted = wanted_of(asked)
    found = site.words.search(wanted, whole(asked.get("page", "")) or 1)
    chosen = {**wanted.trials.chosen, **wanted.own, **wanted.limits, "q": asked.get("q", "")}
    return site.render(
        "words.html",
        here="words",
        headings=HEADINGS,
        carried=carried(asked),
        limits=LIMITS,
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
        replace(trials.filter_of(asked), q=""),
        own,
        {name: value for name in LIMITS if (value := _limit(asked.get(name, ""))) is not None},
    )


def _limit(text: str) -> float | None:
    """A number from -1 to 1; None for anything else."""
    return float(text) if LIMIT.fullmatch(text) else None
