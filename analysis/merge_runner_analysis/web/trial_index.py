"""List of all trials of a database in its present state, with counts and means over them."""

from __future__ import annotations

import io
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar

import duckdb

from merge_runner.records import SIDES
from merge_runner.scenarios.merge.conditions import HUMAN_CONDITIONS
from merge_runner.text_safety import csv_writer
from merge_runner_analysis.web.display_text import csv_cell
from merge_runner_analysis.web.listing import BOTH, FACTOR, Listing, columns_of, list_trials
from merge_runner_analysis.web.phrases import condition_text
from merge_runner_analysis.web.reading import Copies, Copy, Row, readable, records

PAGE = 100
# While a run goes on the database changes all the time: a list of MANY trials, which takes half a
# second, is read anew at most every STANDS_S seconds.
MANY, STANDS_S = 3_000, 20.0
MOST_COUNTED = 50  # filters whose counts are remembered
TrialFilter = Mapping[str, Any]
"""A filter of trials by facet or column: an empty value admits all, a list any of its values.

``who`` is a kind of driver, ``q`` has parts of a name, and ``trials`` are the (trial, spec) behind
a cell of a table.
"""
Facets = dict[str, list[tuple[str, int]]]
Counted = TypeVar("Counted")
FACETS = ("sweep", "run", "who", "model", "variant", "condition", "outcome", "account", "validity",
          "cause", "tag")  # fmt: skip
# Facets of which a trial may have several values.
SEVERAL = ("sweep", "run", "cause", "tag")
TAGGED = """
INSERT INTO several SELECT number, 'tag', tag, 1 FROM listed JOIN (
    SELECT unnest(?::VARCHAR[]) AS trial_id, unnest(?::VARCHAR[]) AS spec_hash,
        unnest(?::VARCHAR[]) AS tag
) USING (trial_id, spec_hash)
"""
SORTS = {"trial": "condition", "outcome": "outcome", "end": "end_time_s", "gap": "gap_m",
         "rmse": "rmse_mps", "invalid": "invalid", "cost": "cost_usd"}  # fmt: skip
SUMMED = ("asked", "invalid", "fallbacks", "no_decision", "attempts", "faults",
          "answers", "others", "unpriced")  # fmt: skip
# A reply that several of the trials share counts and costs once. In their last digits sums differ
# from time to time.
COUNTS = f"""
count(*) AS trials, count(*) FILTER (status <> 'failed') AS ended,
count(*) FILTER (status = 'failed') AS failed, count(*) FILTER (status = 'collided') AS collided,
count(*) FILTER (outcome = 'left first') AS left_first,
count(*) FILTER (outcome = 'right first') AS right_first,
{
    ", ".join(
        f"count(*) FILTER (outcome = ego || ' first' AND ego = '{side}') AS ego_first_{side}, "
        f"count(merged_first) FILTER (status = 'finished' AND ego = '{side}') "
        f"AS ego_merged_{side}"
        for side in SIDES
    )
},
count(*) FILTER (scripted) AS scripted,
{", ".join(f"coalesce(sum({name}), 0)::BIGINT AS {name}" for name in SUMMED)},
round(avg(gap_m), 9) AS gap_m,
string_agg(DISTINCT stand_in, '; ' ORDER BY stand_in) AS stand_in,
flatten(list(of_several)) AS every, list_distinct(every) AS once,
coalesce(len(once), 0) AS shared,
coalesce(sum(attempts), 0)::BIGINT - coalesce(len(every), 0) + coalesce(len(once), 0) AS replies,
round(coalesce(sum(cost_usd), 0) - coalesce(list_sum([reply.usd FOR reply IN every]), 0)
    + coalesce(list_sum([reply.usd FOR reply IN once]), 0), 9) AS cost_usd
"""
# Totals above a list: a fourth of the time of all counts.
TOTALS = """
count(*) AS trials, count(*) FILTER (status = 'failed') AS failed,
count(*) FILTER (status = 'collided') AS collided, round(avg(gap_m), 9) AS gap_m,
coalesce(sum(asked), 0)::BIGINT AS asked, coalesce(sum(invalid), 0)::BIGINT AS invalid
"""
SHOWN = "* EXCLUDE (faults, answers, others, unpriced, of_several)"
# Only a page of the list draws speeds, which take the longest to read.
UNDRAWN = SHOWN.replace(")", ", left_mps, right_mps, left_range_mps, right_range_mps)")
# Requests that failed and were repeated are no fault of a trial.
CAUSES = """
SELECT number, list((value, times) ORDER BY value) AS causes FROM several
WHERE facet = 'cause' AND value NOT LIKE 'attempt: %' GROUP BY number
"""
CONDITIONS = "SELECT DISTINCT condition, projected_headway_m, relative_velocity_mps FROM listed"
EXPORTED = (
    "trial_id spec_hash source model variant condition projected_headway_m relative_velocity_mps "
    "rep pair ego status merged_first end_time_s error scripted stand_in caution outcome validity "
    "time_to_merge_s gap_m rmse_mps joint min_ttc_s account decisions invalid fallbacks attempts "
    "cost_usd"
)


MEMBERS = " JOIN (SELECT number, value AS sweep FROM several WHERE facet = 'sweep') USING (number)"


def where_of(filters: TrialFilter, leave_out: str = "") -> tuple[str, list[Any]]:
    """Return a filter as an SQL condition with its values; ``leave_out`` drops a facet."""
    parts, values = ["true"], list[Any]()
    for name, value in filters.items():
        if name == leave_out or value in ("", (), None):
            continue
        if name == "q":
            words = value.lower().split()
            parts += ["contains(lower(trial_id), ?)"] * len(words)
            values += words
            continue
        if name == "trials":
            parts.append("[trial_id, spec_hash] IN (SELECT unnest(?::VARCHAR[][]))")
        elif name in SEVERAL or name.startswith(FACTOR):
            parts.append("number IN (SELECT number FROM several WHERE facet = ? AND value = ?)")
            values.append(name)
        else:
            parts.append(f"{name} = ?" if isinstance(value, str) else f"list_contains(?, {name})")
        values.append(value)
    return " AND ".join(parts), values


def _order_of(sort: str) -> str:
    direction = "DESC" if sort.startswith("-") else "ASC"
    return f"{SORTS[sort.removeprefix('-')]} {direction} NULLS LAST, trial_id, spec_hash"


class TrialIndex:
    """All trials of a database, as it was when it was last copied."""

    listing: Listing

    def __init__(self, db: Path) -> None:
        self.db, self.copies = db, Copies(db)
        self._copy: Copy | None = None
        self._read_at = 0.0
        self._lock = threading.RLock()
        self._tags: tuple[tuple[str, str, str], ...] = ()
        self._counted: dict[str, Any] = {}

    def refresh(self, *, at_once: bool = False) -> bool:
        """Take in what is new in the database; returns whether anything was.

        A long list that was read lately stands, unless it has to be ``at_once``. Raises UsageError
        and StoreError, but not where another program holds what is listed.
        """
        with self._lock:
            is_long = self._copy is not None and self.state["trials"] > MANY
            if is_long and not at_once and time.monotonic() < self._read_at + STANDS_S:
                return False
            copy = self.copies.current()
            if copy is self._copy:
                return False
            with readable(self.db):
                self.listing, self._tags, self._counted = list_trials(copy), (), {}
            self._copy, self._read_at = copy, time.monotonic()
            return True

    @property
    def state(self) -> Row:
        """State of the list, which changes with the listed ``trials`` or their values."""
        return self.listing.state

    @property
    def has_humans(self) -> bool:
        """Return whether any human trial is listed."""
        return bool(self.ask("SELECT 1 FROM listed WHERE who = 'humans' LIMIT 1"))

    def ask(self, sql: str, *values: object) -> list[Row]:
        """Return the rows of a query of ours."""
        with self._lock:
            return records(self.listing.connection, sql, values)

    def cursor(self) -> duckdb.DuckDBPyConnection:
        """Return another connection: its queries keep no page waiting."""
        with self._lock:
            connection = self.listing.connection.cursor()
        connection.execute(BOTH)
        return connection

    def keep(self, numbers: Sequence[int]) -> None:
        """List no trials but those with these numbers."""
        self.ask("DELETE FROM listed WHERE number NOT IN (SELECT unnest(?))", numbers)
        self._counted = {}

    def tag(self, tags: tuple[tuple[str, str, str], ...]) -> None:
        """Know the tags that readers gave: (trial, spec, tag), each once."""
        with self._lock:
            if tags != self._tags:
                self.ask("DELETE FROM several WHERE facet = 'tag'")
                self.ask(TAGGED, *columns_of(tags))
                self._tags, self._counted = tags, {}

    def factors(self) -> list[str]:
        """Return the factors of the listed studies but the prompt; none if only models differ."""
        rows = self.ask(
            f"SELECT DISTINCT facet FROM several WHERE facet LIKE '{FACTOR}%' ORDER BY ALL"  # noqa: S608 # constants
        )
        names = [row["facet"].removeprefix(FACTOR) for row in rows]
        return names if names != ["model"] else []

    def facets(self, filters: TrialFilter) -> Facets:
        """Return each facet's values with the number of trials left under the other filters."""

        def compute() -> Facets:
            names = (*FACETS, *(f"{FACTOR}{name}" for name in self.factors()))
            return facets_of(self.listing.connection, "listed", names, filters)

        return self._once(("facets", filters), compute)

    def counts(self, filters: TrialFilter, *columns: str) -> list[Row]:
        """Return a filter's trials grouped by columns: counts of all, means of those with a value.

        Without columns it is one row. A trial counts in each ``sweep`` of which it is a member.
        """
        where, values = where_of(filters)
        table = f"listed{MEMBERS}" if "sweep" in columns else "listed"
        named = "".join(f"{name}, " for name in columns)
        sql = (
            f"SELECT * EXCLUDE (every, once) FROM (SELECT {named}{COUNTS} FROM {table} "  # noqa: S608 # constants
            f"WHERE {where} GROUP BY ALL) ORDER BY ALL"
        )
        return self._once((columns, filters), lambda: self.ask(sql, *values))

    def totals(self, filters: TrialFilter) -> list[Row]:
        """Return a filter's totals by model, for the line above the list."""
        where, values = where_of(filters)
        sql = f"SELECT model, {TOTALS} FROM listed WHERE {where} GROUP BY ALL ORDER BY model"  # noqa: S608 # constants
        return self._once(("totals", filters), lambda: self.ask(sql, *values))

    def _once(self, of: object, compute: Callable[[], Counted]) -> Counted:
        """Return a count of the present list, from memory after the first call."""
        with self._lock:
            if len(self._counted) > MOST_COUNTED:
                self._counted.clear()
            name = repr(of)
            if name not in self._counted:
                self._counted[name] = compute()
            counted: Counted = self._counted[name]
            return counted

    def every(self, filters: TrialFilter, sort: str = "trial") -> list[Row]:
        """Return all trials of a filter; ``-gap`` sorts largest first, missing ones last."""
        where, values = where_of(filters)
        return self.ask(
            f"SELECT {UNDRAWN} FROM listed WHERE {where} ORDER BY {_order_of(sort)}",  # noqa: S608 # constants
            *values,
        )

    def page(self, filters: TrialFilter, sort: str, number: int) -> list[Row]:
        """Return the trials of a page from 1, with their speeds and the ``causes`` of errors."""
        where, values = where_of(filters)
        order = _order_of(sort)
        sql = (
            f"SELECT {SHOWN} FROM listed SEMI JOIN (SELECT number FROM listed WHERE {where} "  # noqa: S608 # constants
            f"ORDER BY {order} LIMIT {PAGE} OFFSET {PAGE * (number - 1)}) USING (number) "
            f"LEFT JOIN ({CAUSES}) USING (number) ORDER BY {order}"
        )
        return self._once((sort, number, filters), lambda: self.ask(sql, *values))

    def find(self, trial_id: str, spec_hash: str = "") -> Row | None:
        """Return a trial; of several with its name the one of that spec, or any."""
        rows = self.ask(
            f"SELECT {UNDRAWN} FROM listed WHERE trial_id = ? AND spec_hash LIKE ? "  # noqa: S608 # constants
            "ORDER BY spec_hash LIMIT 1",
            *(trial_id, spec_hash or "%"),
        )
        return next(iter(rows), None)

    def in_words(self, condition: str) -> str:
        """Return a condition in words; empty where no human drove it and it has no trial."""

        def read() -> dict[str, str]:
            known = {
                name: (of.projected_headway_m, of.relative_velocity_mps)
                for name, of in HUMAN_CONDITIONS.items()
            }
            played = {name: of for name, *of in map(dict.values, self.ask(CONDITIONS))}
            return {name: condition_text(*of) for name, of in (known | played).items()}

        return self._once("conditions", read).get(condition, "")

    def export(self, filters: TrialFilter, sort: str) -> str:
        """Return all trials of a filter as CSV, with a column for each factor but the model."""
        factors = [name for name in self.factors() if name != "model"]
        names, lines = EXPORTED.split(), io.StringIO()
        writer = csv_writer(lines)
        writer.writerow(map(csv_cell, [*names, *(f"{FACTOR}{name}" for name in factors)]))
        for row in self.every(filters, sort):
            levels = dict(level.split("=", 1) for level in row["levels"] or ())
            writer.writerow(map(csv_cell, [*map(row.get, names), *map(levels.get, factors)]))
        return lines.getvalue()


def facets_of(
    cursor: duckdb.DuckDBPyConnection, listed: str, names: Sequence[str], filters: TrialFilter
) -> Facets:
    """Return each facet's values with the number of rows left under the other filters."""
    counts, values = [], list[Any]()
    for name in names:
        where, wants = where_of(filters, leave_out=name)
        table, value = listed, name
        if name in SEVERAL or name.startswith(FACTOR):
            table, value = f"{listed} JOIN (FROM several WHERE facet = ?) USING (number)", "value"
            wants = [name, *wants]
        counts.append(
            f"SELECT ? AS facet, {value} AS value, count(*) AS times FROM {table} "  # noqa: S608 # constants
            f"WHERE {where} AND {value} IS NOT NULL GROUP BY ALL"
        )
        values += [name, *wants]
    facets: Facets = {name: [] for name in names}
    for facet, value, times in cursor.execute(
        f"{' UNION ALL '.join(counts)} ORDER BY ALL", values
    ).fetchall():
        facets[facet].append((value, times))
    return facets
