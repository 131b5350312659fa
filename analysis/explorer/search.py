"""Search in what drivers said, planned and drove, beside the list of trials."""

from __future__ import annotations

import threading
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import duckdb

from merge_runner_analysis.explorer.catalogue import SEVERAL, Catalogue, Filter
from merge_runner_analysis.explorer.database_copy import Copies
from merge_runner_analysis.explorer.reading import Row, records
from merge_runner_analysis.explorer.snippets import Snippet, snippet

PAGE = 50
LONGEST = 65_536  # characters of a text that are searched
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
        failure, {ACTION.format("plan")} AS planned, {ACTION.format("applied")} AS driven
        , list_avg(plan) AS plan_mean, list_avg(applied) AS drive_mean
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
class Hit:
    """A decision with its trial, and what of its words was looked for; None: it said nothing."""

    row: Row
    snippet: Snippet | None


@dataclass(frozen=True, slots=True)
class Found:
    """A page of hits, and how many there are in how many trials.

    ``crossed`` counts them by what was said, M or Y, and by what was planned.
    """

    hits: list[Hit]
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
    folded = FOLDED.format(column=column)
    limits = " AND ".join(["true", *map(LIMITS.__getitem__, wanted.limits)])
    hits = HITS.format(table=table, place=place, limits=limits)
    values: list[Any] = [*wanted.limits.values()]
    if wanted.terms:
        holds = " AND ".join([f"contains({folded}, lower(?))"] * len(wanted.terms))
        hits += f"AND place IN (SELECT rowid FROM copied.{table} WHERE {holds})"  # noqa: S608 # constants
        values += wanted.terms
    connection.execute(hits, values)
    connection.execute(
        "CREATE TEMP TABLE counted AS "  # noqa: S608 # constants
        f"SELECT number, {', '.join(OWN_FACETS)}, count(*) AS times "
        "FROM hits GROUP BY ALL"
    )
    where, values = wanted.where()
    (totals,) = records(
        connection,
        "SELECT coalesce(sum(times), 0)::BIGINT AS decisions, count(DISTINCT number) AS trials "  # noqa: S608 # constants
        f"FROM counted JOIN listed USING (number) WHERE {where}",
        values,
    )
    crossed: dict[str, dict[str, int]] = {}
    for letter, plan, times in connection.execute(
        "SELECT tactical, planned, sum(times)::BIGINT FROM counted JOIN listed USING (number) "  # noqa: S608 # constants
        f"WHERE {where} AND tactical <> 'none' AND planned IS NOT NULL GROUP BY ALL",
        values,
    ).fetchall():
        crossed.setdefault(letter, {})[plan] = times
    number = min(page, max(1, -(-totals["decisions"] // PAGE)))
    rows = records(
        connection,
        "SELECT trial_id, spec_hash, model, variant, condition, outcome, hits.* "  # noqa: S608 # constants
        f"FROM hits JOIN listed USING (number) WHERE {where} "
        f"ORDER BY trial_id, spec_hash, hits.decision, hits.side LIMIT {PAGE} OFFSET ?",
        [*values, PAGE * (number - 1)],
    )
    texts = connection.execute(
        f"SELECT rowid, left({column}, {LONGEST}), {folded} FROM copied.{table} "  # noqa: S608 # constants
        f"WHERE {column} IS NOT NULL AND rowid IN (SELECT unnest(?::BIGINT[]))",
        [[row["place"] for row in rows]],
    ).fetchall()
    said = {place: (text, folded) for place, text, folded in texts}
    lowered = connection.execute("SELECT lower(unnest(?::VARCHAR[]))", [wanted.terms]).fetchall()
    terms = [term for (term,) in lowered]
    return Found(
        [
            Hit(row, snippet(*said[row["place"]], terms) if row["place"] in said else None)
            for row in rows
        ],
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
            f"SELECT {name}, sum(times)::BIGINT FROM counted JOIN {table} USING (number) "  # noqa: S608 # constants
            f"WHERE {where} AND {name} IS NOT NULL GROUP BY ALL ORDER BY ALL",
            values,
        ).fetchall()
    return found
