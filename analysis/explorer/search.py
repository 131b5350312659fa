"""Search in what drivers said, planned and drove, beside the list of trials."""

from __future__ import annotations

import re
import threading
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import duckdb

from merge_runner_analysis.explorer.catalogue import SEVERAL, Catalogue, Filter
from merge_runner_analysis.explorer.database_copy import Copies
from merge_runner_analysis.explorer.reading import Row, records

PAGE = 50
LONGEST = 65_536  # characters of a text that are searched
MOST_TERMS, LONGEST_QUERY = 12, 300
TERM = re.compile(r'"([^"]*)"?|([^\s"]+)')
AROUND = 70  # characters on each side of a match
MOST_MATCHES = 20  # that are shown of a text
# Within this part of the greatest acceleration a driver holds its speed, beyond it goes or brakes.
HOLDS = 0.08
# What is searched: a column of a table, and which of the table's rows is that of a decision.
KINDS = {
    "rationales": ("decisions", "rationale", "any_value(rowid)"),
    "replies": ("calls", "reply", "arg_max(rowid, attempt) FILTER (reply IS NOT NULL)"),
}
OWN_FACETS = ("tactical", "planned", "driven", "switch", "failure")
# In figures: the least or the most of a mean, as a part of the greatest acceleration.
LIMITS = {
    f"{name}_{end}": f"{column} {'>=' if end == 'from' else '<='} ?"
    for name, column in (("planned", "plan_mean"), ("driven", "drive_mean"))
    for end in ("from", "to")
}
TRIAL_FACETS = ("sweep", "model", "variant", "condition", "outcome", "account", "tag")
ACTION = (
    f"CASE WHEN list_avg({{0}}) < -{HOLDS} THEN 'brake' WHEN list_avg({{0}}) > {HOLDS} THEN 'go' "
    "WHEN list_avg({0}) IS NOT NULL THEN 'hold' END"
)
# A line break is a space to whoever looks for a phrase.
FOLDED = f"lower(translate(left({{column}}, {LONGEST}), chr(10) || chr(13) || chr(9), '   '))"
# A change of mind is between what a driver said and what it had said before. ``place`` is the row
# of the text: all texts are read to find some of them, and those of a page to show them.
HITS = f"""
CREATE TEMP TABLE hits AS
WITH decided AS (
    SELECT trial_id, spec_hash, side, decision, time_s, coalesce(tactical, 'none') AS tactical,
        CASE WHEN tactical <> lag(tactical IGNORE NULLS) OVER said
            THEN lag(tactical IGNORE NULLS) OVER said || ' to ' || tactical END AS switch,
        failure, {ACTION.format("plan")} AS planned, {ACTION.format("applied")} AS driven,
        list_avg(plan) AS plan_mean, list_avg(applied) AS drive_mean
    FROM copied.decisions WHERE call_key IS NOT NULL
    WINDOW said AS (PARTITION BY trial_id, spec_hash, side ORDER BY decision)
), places AS (
    SELECT trial_id, spec_hash, side, decision, {{place}} AS place
    FROM copied.{{table}} GROUP BY ALL
)
SELECT number, side, decision, time_s, {", ".join(OWN_FACETS)}, plan_mean, place
FROM decided JOIN listed USING (trial_id, spec_hash)
    LEFT JOIN places USING (trial_id, spec_hash, side, decision)
WHERE {{limits}}
"""  # noqa: S608 # constants


@dataclass(frozen=True, slots=True)
class Wanted:
    """Which decisions are wanted: of which trials, with which words; an empty text wants all."""

    kind: str
    terms: tuple[str, ...]
    trials: Filter
    own: Mapping[str, str]
    """By the names of ``OWN_FACETS``."""
    limits: Mapping[str, float] = field(default_factory=dict)
    """By the names of ``LIMITS``."""

    def where(self, leave_out: str = "") -> tuple[str, list[Any]]:
        """The filter but for the words as SQL with its values; without one facet."""
        where, values = self.trials.where(leave_out)
        for name, value in self.own.items():
            if name != leave_out:
                where += f" AND {name} = ?"
                values.append(value)
        return where, values


@dataclass(frozen=True, slots=True)
class Found:
    """A page of decisions, with the ``pieces`` of their words, and how many there are.

    ``crossed`` counts them by what was said, M or Y, and by what was planned.
    """

    hits: list[Row]
    decisions: int
    trials: int
    page: int
    facets: dict[str, list[tuple[str, int]]]
    crossed: dict[str, dict[str, int]]

    @property
    def last_page(self) -> int:
        """The number of pages."""
        return max(1, -(-self.decisions // PAGE))


@dataclass(slots=True)
class Words:
    """What the drivers of a database said. One search goes on at a time."""

    catalogue: Catalogue
    copies: Copies
    _lock: threading.Lock = field(default_factory=threading.Lock)

    def search(self, wanted: Wanted, page: int) -> Found:
        """What is found, and a page of it, from 1; raises UsageError and StoreLocked."""
        copy = self.copies.current()
        with self._lock, self.catalogue.cursor() as connection:
            connection.execute(f"ATTACH {copy.file} AS copied (READ_ONLY)")
            try:
                return _searched(connection, wanted, page)
            finally:
                connection.execute("DETACH copied")


def _searched(connection: duckdb.DuckDBPyConnection, wanted: Wanted, page: int) -> Found:
    table, column, place = KINDS[wanted.kind]
    limits = " AND ".join(["true", *map(LIMITS.__getitem__, wanted.limits)])
    hits = HITS.format(table=table, place=place, limits=limits)
    values: list[Any] = [*wanted.limits.values()]
    if wanted.terms:
        holds = " AND ".join(
            [f"contains({FOLDED.format(column=column)}, lower(?))"] * len(wanted.terms)
        )
        hits += f"AND place IN (SELECT rowid FROM copied.{table} WHERE {holds})"  # noqa: S608 # constants
        values += wanted.terms
    connection.execute(hits, values)
    where, values = wanted.where()
    chosen = f"FROM hits JOIN listed USING (number) WHERE {where}"
    (totals,) = records(
        connection,
        f"SELECT count(*) AS decisions, count(DISTINCT number) AS trials {chosen}",
        values,
    )
    crossed: dict[str, dict[str, int]] = {}
    for letter, plan, times in connection.execute(
        f"SELECT tactical, planned, count(*) {chosen} AND tactical <> 'none' "
        "AND planned IS NOT NULL GROUP BY ALL",
        values,
    ).fetchall():
        crossed.setdefault(letter, {})[plan] = times
    number = min(page, max(1, -(-totals["decisions"] // PAGE)))
    rows = records(
        connection,
        f"SELECT trial_id, spec_hash, outcome, hits.* {chosen} "
        f"ORDER BY trial_id, spec_hash, hits.decision, hits.side LIMIT {PAGE} OFFSET ?",
        [*values, PAGE * (number - 1)],
    )
    texts = connection.execute(
        f"SELECT rowid, left({column}, {LONGEST}) FROM copied.{table} "  # noqa: S608 # constants
        f"WHERE {column} IS NOT NULL AND rowid IN (SELECT unnest(?::BIGINT[]))",
        [[row["place"] for row in rows]],
    ).fetchall()
    pieces = {place: pieces_of(text, wanted.terms) for place, text in texts}
    return Found(
        [{**row, "pieces": pieces.get(row["place"])} for row in rows],
        **totals,
        page=number,
        facets=_facets(connection, wanted),
        crossed=crossed,
    )


def _facets(
    connection: duckdb.DuckDBPyConnection, wanted: Wanted
) -> dict[str, list[tuple[str, int]]]:
    """Each facet's values with how many decisions they would leave, the others as wanted."""
    found: dict[str, list[tuple[str, int]]] = {}
    for name in (*OWN_FACETS, *TRIAL_FACETS):
        where, values = wanted.where(leave_out=name)
        table = f"listed JOIN {SEVERAL[name]} USING (number)" if name in SEVERAL else "listed"
        found[name] = connection.execute(
            f"SELECT {name}, count(*) FROM hits JOIN {table} USING (number) "  # noqa: S608 # constants
            f"WHERE {where} AND {name} IS NOT NULL GROUP BY ALL ORDER BY ALL",
            values,
        ).fetchall()
    return found


def terms_of(query: str) -> tuple[str, ...]:
    """The words of a query, and its phrases in quotes.

    >>> terms_of('yield "collision course')
    ('yield', 'collision course')
    """
    words = (
        " ".join((quoted or word).split()) for quoted, word in TERM.findall(query[:LONGEST_QUERY])
    )
    return tuple(dict.fromkeys(filter(None, words)))[:MOST_TERMS]


def pieces_of(text: str, terms: Sequence[str]) -> list[tuple[str, bool]]:
    """A text cut into what stands around the terms and, True, the terms; far from them is left out.

    Without one it is the beginning.
    """
    longest_first = sorted(terms, key=len, reverse=True)
    looked_for = "|".join(re.escape(term).replace(r"\ ", r"\s") for term in longest_first)
    cut = re.split(f"({looked_for})", text, flags=re.IGNORECASE) if terms else [text]
    if len(cut) == 1:
        return [(_around(text, 3 * AROUND, 0), False)]
    last = min(len(cut) - 1, 2 * MOST_MATCHES)
    return [
        (part if i % 2 else _around(part, AROUND * (i > 0), AROUND * (i < last)), bool(i % 2))
        for i, part in enumerate(cut[: last + 1])
    ]


def _around(text: str, first: int, last: int) -> str:
    """The first and the last characters of a text, in whole words."""
    if len(text) <= first + last:
        return text
    return f"{text[:first].rpartition(' ')[0]} … {text[len(text) - last :].partition(' ')[2]}"
