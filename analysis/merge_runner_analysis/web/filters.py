"""Filter and order of trials in an address."""

from __future__ import annotations

from collections.abc import Mapping

from merge_runner_analysis.web.catalogue import FACETS, SORTS
from merge_runner_analysis.web.listing import FACTOR
from merge_runner_analysis.web.search import LONGEST_QUERY, MOST_TERMS
from merge_runner_analysis.web.site import TooMuch

# Facets that may be chosen at once, and characters of their values. A longer filter is a fault
# within DuckDB, or the end of the process.
MOST_CHOSEN, LONGEST_VALUE = 30, 1_000
# Labels of facets that have another name in an address.
HEADINGS = {
    "sweep": "run",
    "run": "name of run",
    "who": "kind of driver",
    "model": "driver",
    "variant": "prompt",
    "condition": "start",
    "account": "why",
    "validity": "replies",
    "cause": "error",
}


def filter_of(asked: Mapping[str, str]) -> dict[str, str]:
    """Return the filter in an address; raises TooMuch."""
    filters = {
        name: value
        for name, value in asked.items()
        if value and (name in {*FACETS, "q"} or name.startswith(FACTOR))
    }
    words = filters.get("q", "")
    if len(words) > LONGEST_QUERY or len(words.split()) > MOST_TERMS:
        raise TooMuch(
            f"a search has up to {MOST_TERMS} words and {LONGEST_QUERY} characters, this one "
            f"{len(words.split()):,} and {len(words):,}"
        )
    longest = max(map(len, asked.values()), default=0)
    if len(filters) > MOST_CHOSEN or longest > LONGEST_VALUE:
        raise TooMuch(
            f"a filter has up to {MOST_CHOSEN} parts of up to {LONGEST_VALUE:,} characters, this "
            f"one {len(filters):,} of up to {longest:,}"
        )
    return filters


def sort_of(asked: Mapping[str, str]) -> str:
    """Return the order in an address; an unknown one is that of the names."""
    sort = asked.get("sort", "trial")
    return sort if sort.removeprefix("-") in SORTS else "trial"
