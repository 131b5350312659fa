"""Search in what drivers said, planned and drove, beside the list of trials."""

from __future__ import annotations

import re
import threading
from collections.abc import Mapping, Sequence
from typing import Any

from merge_runner_analysis.web.reading import records
from merge_runner_analysis.web.trial.account import HOLDS
from merge_runner_analysis.web.trial_index import TrialIndex, facets_of, where_of

PAGE = 50
LONGEST = 65_536  # characters of a text that are searched
MOST_TERMS, LONGEST_QUERY = 12, 300
TERM = re.compile(r'"([^"]*)"?|([^\s"]+)')
SHOWN, BEFORE = 600, 200  # characters that are shown of a text, and of these before a match
NOT_ASKED = "not asked"  # whose prompt asked for no M or Y, whatever the reply says
FACETS = ("tactical", "planned", "driven", "switch", "failure", "sweep", "model", "variant",
          "condition", "outcome", "account", "tag")  # fmt: skip
# In figures: the least or the most of a mean, as a part of the greatest acceleration.
LIMITS = {
    f"{name}_{end}": f"{column} {'>=' if end == 'from' else '<='} ?::DOUBLE"
    for name, column in (("planned", "plan_mean"), ("driven", "drive_mean"))
    for end in ("from", "to")
}
ACTION = (
    f"CASE WHEN list_avg({{0}}) < -{HOLDS} THEN 'brake' WHEN list_avg({{0}}) > {HOLDS} THEN 'go' "
    "WHEN list_avg({0}) IS NOT NULL THEN 'hold' END"
)
# A line break is a space to whoever looks for a phrase.
FOLDED = f"lower(translate(left(rationale, {LONGEST}), chr(10) || chr(13) || chr(9), '   '))"
# A change of mind is between what a driver, asked for it, said and what it had said before.
# ``place`` is the row of the text: a search reads all texts, a page only those that it shows.
HITS = f"""
CREATE TEMP TABLE hits AS
WITH decided AS (
    SELECT trial_id, spec_hash, side, decision, time_s,
        if(is_asked, coalesce(word, 'none'), '{NOT_ASKED}') AS tactical,
        CASE WHEN word <> lag(word IGNORE NULLS) OVER said
            THEN lag(word IGNORE NULLS) OVER said || ' to ' || word END AS switch,
        coalesce(trim(rationale), '') <> '' AS has_words, failure,
        {ACTION.format("plan")} AS planned, {ACTION.format("applied")} AS driven,
        list_avg(plan) AS plan_mean, list_avg(applied) AS drive_mean, place
    FROM (
        SELECT * EXCLUDE (tactical), if(is_asked, tactical, NULL) AS word
        FROM (SELECT *, rowid AS place, rowid NOT IN (FROM unasked) AS is_asked FROM decisions)
        WHERE call_key IS NOT NULL
    )
    WINDOW said AS (PARTITION BY trial_id, spec_hash, side ORDER BY decision)
)
SELECT number, side, decision, time_s, tactical, switch, has_words, failure, planned, driven,
    plan_mean, place
FROM decided JOIN listed USING (trial_id, spec_hash) WHERE {{}}
"""  # noqa: S608 # constants
FOUND = "hits JOIN listed USING (number)"


SEARCHING = threading.Lock()  # a search reads all texts: they are made one at a time


def search(
    trial_index: TrialIndex,
    filters: Mapping[str, str],
    terms: Sequence[str] = (),
    limits: Mapping[str, str] | None = None,
    page: int = 1,
) -> dict[str, Any]:
    """Return decisions with all ``terms`` within ``limits``; ``hits`` are one page's.

    Those of mock models are the last. Each has the ``pieces`` of its words. ``crossed`` counts
    all of them by intention, M or Y, and by plan.
    """
    limits = limits or {}
    conditions = ["true", *(LIMITS[name] for name in limits)]
    if terms:
        holding = " AND ".join([f"contains({FOLDED}, lower(?))"] * len(terms))
        conditions.append(f"place IN (SELECT rowid FROM decisions WHERE {holding})")  # noqa: S608 # constants
    where, values = where_of(filters)
    matches = f"FROM {FOUND} WHERE {where}"
    with SEARCHING, trial_index.cursor() as connection:
        connection.execute(HITS.format(" AND ".join(conditions)), [*limits.values(), *terms])
        (totals,) = records(
            connection,
            "SELECT count(*) AS decisions, count(DISTINCT number) AS trials, "
            "count(*) FILTER (NOT has_words) AS silent, "
            f"count(*) FILTER (tactical = '{NOT_ASKED}') AS unasked, "
            "histogram(planned) FILTER (tactical = 'M') AS \"M\", "
            f"histogram(planned) FILTER (tactical = 'Y') AS \"Y\" {matches}",
            values,
        )
        last_page = max(1, -(-totals["decisions"] // PAGE))
        page = min(page, last_page)
        rows = records(
            connection,
            f"SELECT trial_id, spec_hash, outcome, hits.* {matches} "
            "ORDER BY who, trial_id, spec_hash, hits.decision, hits.side "
            f"LIMIT {PAGE} OFFSET ?",
            [*values, PAGE * (page - 1)],
        )
        texts = dict(
            connection.execute(
                f"SELECT rowid, left(rationale, {LONGEST}) FROM decisions "  # noqa: S608 # constants
                "WHERE rowid IN (SELECT unnest(?::BIGINT[]))",
                [[row["place"] for row in rows]],
            ).fetchall()
        )
        facets = facets_of(connection, FOUND, FACETS, filters)
    crossed = {letter: counts for letter in "MY" if (counts := totals.pop(letter))}
    for row in rows:
        text = texts.get(row["place"]) or ""
        row["pieces"] = pieces_of(text, terms) if row["has_words"] else None
    return {**totals, "hits": rows, "page": page, "last_page": last_page, "facets": facets,
            "crossed": crossed}  # fmt: skip


def terms_of(query: str) -> tuple[str, ...]:
    """Return the words of a query, and its phrases in quotes.

    >>> terms_of('yield "collision course')
    ('yield', 'collision course')
    """
    words = (
        " ".join((quoted or word).split()) for quoted, word in TERM.findall(query[:LONGEST_QUERY])
    )
    return tuple(dict.fromkeys(filter(None, words)))[:MOST_TERMS]


def pieces_of(text: str, terms: Sequence[str]) -> list[tuple[str, bool]]:
    """Cut a part of a text with its first match into terms, True, and the text between them."""
    longest_first = sorted(terms, key=len, reverse=True)
    looked_for = "|".join(re.escape(term).replace(r"\ ", r"\s") for term in longest_first)
    pattern = re.compile(f"({looked_for or '(?!)'})", re.IGNORECASE)
    first = pattern.search(text)
    start = max(0, first.start() - BEFORE) if first else 0
    shown = f"{'… ' * (start > 0)}{text[start : start + SHOWN]}{' …' * (start + SHOWN < len(text))}"
    return [(part, bool(i % 2)) for i, part in enumerate(pattern.split(shown))]
