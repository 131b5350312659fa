"""Search in drivers' words: decisions whose words contain a query's words."""

from __future__ import annotations

import re
from collections.abc import Mapping

from merge_runner_analysis.web.scope import HEADINGS as OF_TRIALS
from merge_runner_analysis.web.scope import carried, facets_shown, filter_of
from merge_runner_analysis.web.search import FACETS, LIMITS, search, terms_of
from merge_runner_analysis.web.site import Site
from merge_runner_analysis.web.urls import whole

HEADINGS = OF_TRIALS | {"tactical": "said", "switch": "change of mind", "failure": "invalid"}
# A number from -1 to 1.
LIMIT = re.compile(r"-?(0?\.\d{1,6}|[01](\.0{1,6})?)")


def words_page(site: Site, asked: Mapping[str, str]) -> str:
    """Return a page of the decisions that match an address."""
    query = asked.get("q", "")
    filters = filter_of(asked) | {name: asked.get(name, "") for name in FACETS}
    filters = {name: value for name, value in filters.items() if value and name != "q"}
    limits = {name: text for name in LIMITS if LIMIT.fullmatch(text := asked.get(name, ""))}
    chosen = {**filters, **limits, "q": query}
    page = whole(asked.get("page", "")) or 1
    result = search(site.catalogue, filters, terms_of(query), limits, page)
    return site.render(
        "words.html",
        view="words",
        headings=HEADINGS,
        carried=carried(asked),
        limits=LIMITS,
        result=result,
        facets=facets_shown(site, result["facets"]),
        chosen=chosen,
        kept=chosen,
    )
