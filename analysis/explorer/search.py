"""Search in what drivers said: a copy of their words in a file of our own.

The database is open only while words are copied; searching reads the copy, beside the list of
trials, and keeps no page waiting.
"""

from __future__ import annotations

import tempfile
import threading
import time
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import duckdb

from analysis.explorer.catalogue import SEVERAL, Catalogue, Filter
from analysis.explorer.reading import Row, records
from analysis.explorer.snippets import Snippet, snippet
from merge_runner.errors import StoreLocked
from merge_runner.text_safety import quoted

PAGE = 50
LONGEST = 65_536  # characters of a text that are searched
AT_ONCE = 500  # trials whose words are copied while the file is held
READING_S = 1.0  # a page waits so long for words that are not copied yet
# What is searched: a column of a table, and the row of a decision that holds it, which of a call is
# that of the last reply.
KINDS = {
    "rationales": (
        "decisions",
        "rationale",
        "SELECT trial_id, spec_hash, side, decision, rowid AS place FROM decisions "
        "SEMI JOIN wanted USING (trial_id, spec_hash)",
    ),
    "replies": (
        "calls",
        "reply",
        "SELECT trial_id, spec_hash, side, decision, arg_max(rowid, attempt) AS place FROM calls "
        "SEMI JOIN wanted USING (trial_id, spec_hash) WHERE reply IS NOT NULL GROUP BY ALL",
    ),
}
TABLES = """
CREATE TABLE IF NOT EXISTS words.taken_{kind} (number INTEGER);
CREATE TABLE IF NOT EXISTS words.{kind} (number INTEGER, side VARCHAR, decision INTEGER,
    time_s DOUBLE, tactical VARCHAR, switch VARCHAR, failure VARCHAR, text VARCHAR, folded VARCHAR);
DELETE FROM words.taken_{kind} WHERE number NOT IN (SELECT number FROM memory.listed);
DELETE FROM words.{kind} WHERE number NOT IN (SELECT number FROM words.taken_{kind});
"""
WAITING = """
FROM memory.listed WHERE decisions > 0 AND number NOT IN (SELECT number FROM words.taken_{kind})
"""
# Texts are read by the numbers of their rows: else all are read, to find a few. A change of mind is
# between what a driver said and what it had said before. A line break is a space to whoever looks
# for a phrase.
TAKE = f"""
BEGIN;
INSERT INTO words.{{kind}} BY NAME
WITH wanted AS MATERIALIZED (SELECT number, trial_id, spec_hash {{waiting}}),
places AS MATERIALIZED ({{places}}),
texts AS (SELECT rowid AS place, left({{column}}, {LONGEST}) AS text
    FROM {{table}} WHERE rowid IN (SELECT place FROM places)),
decided AS (
    SELECT number, trial_id, spec_hash, side, decision, time_s,
        coalesce(tactical, 'none') AS tactical,
        CASE WHEN tactical <> lag(tactical IGNORE NULLS) OVER said
            THEN lag(tactical IGNORE NULLS) OVER said || ' to ' || tactical END AS switch,
        failure
    FROM decisions JOIN wanted USING (trial_id, spec_hash) WHERE call_key IS NOT NULL
    WINDOW said AS (PARTITION BY number, side ORDER BY decision)
)
SELECT decided.* EXCLUDE (trial_id, spec_hash), text,
    lower(translate(text, chr(10) || chr(13) || chr(9), '   ')) AS folded
FROM decided LEFT JOIN places USING (trial_id, spec_hash, side, decision)
    LEFT JOIN texts USING (place);
INSERT INTO words.taken_{{kind}} SELECT number {{waiting}};
COMMIT;
"""  # noqa: S608 # constants
WITHOUT_A_LOG = "RECOVERY_MODE no_wal_writes, ROW_GROUP_SIZE 16384"
OWN_FACETS = ("tactical", "switch", "failure")
TRIAL_FACETS = ("model", "variant", "condition", "outcome", "account", "tag")


@dataclass(frozen=True, slots=True)
class Wanted:
    """Which decisions are wanted: of which trials, with which words; an empty text wants all."""

    kind: str
    terms: tuple[str, ...]
    trials: Filter
    own: Mapping[str, str]
    """By the names of ``OWN_FACETS``."""

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

    ``unread`` trials are still to be searched.
    """

    hits: list[Hit]
    decisions: int
    trials: int
    page: int
    facets: dict[str, list[tuple[str, int]]]
    unread: int

    @property
    def last_page(self) -> int:
        """The number of pages."""
        return max(1, -(-self.decisions // PAGE))


@dataclass(slots=True)
class Words:
    """What the drivers of a database said. One search or copy goes on at a time."""

    catalogue: Catalogue
    _lock: threading.Lock = field(default_factory=threading.Lock)
    _folder: tempfile.TemporaryDirectory[str] | None = None

    def search(self, wanted: Wanted, page: int) -> Found:
        """What is found in the words that are copied by now, and a page of it, from 1."""
        with self._lock, self.catalogue.cursor() as connection:
            self._prepare(connection, wanted.kind)
            with suppress(StoreLocked):  # what is read is searched
                self._take(connection, wanted.kind)
            return _searched(connection, wanted, page)

    def every(self, kind: str) -> list[Row]:
        """What all drivers said, in the order of the trials; raises StoreError."""
        with self._lock, self.catalogue.cursor() as connection:
            self._prepare(connection, kind)
            while _unread(connection, kind):
                self._take(connection, kind)
            return records(
                connection,
                "SELECT number, side, decision, time_s, tactical, switch, failure, text "  # noqa: S608 # constants
                f"FROM words.{kind} JOIN listed USING (number) "
                "ORDER BY trial_id, spec_hash, decision, side",
                (),
            )

    @property
    def folder(self) -> Path | None:
        """Where the copy is, once there is one."""
        return None if self._folder is None else Path(self._folder.name)

    def close(self) -> None:
        """Delete the copy."""
        if self._folder is not None:
            self._folder.cleanup()
            self._folder = None

    def _prepare(self, connection: duckdb.DuckDBPyConnection, kind: str) -> None:
        """Have a place for words, where those of trials that are gone go, too."""
        names = connection.execute("SELECT database_name FROM duckdb_databases()").fetchall()
        if ("words",) not in names:  # the catalogue has begun anew, or we begin
            self.close()
            self._folder = tempfile.TemporaryDirectory()
            file = quoted(f"{self._folder.name}/words.duckdb")
            connection.execute(f"ATTACH {file} AS words ({WITHOUT_A_LOG})")
        connection.execute(TABLES.format(kind=kind))

    def _take(self, connection: duckdb.DuckDBPyConnection, kind: str) -> None:
        """Copy words, for a moment; raises UsageError and StoreError."""
        until = time.monotonic() + READING_S
        table, column, places = KINDS[kind]
        some = f"{WAITING.format(kind=kind)} ORDER BY number LIMIT {AT_ONCE}"
        take = TAKE.format(kind=kind, table=table, column=column, places=places, waiting=some)
        while time.monotonic() < until and _unread(connection, kind):
            self.catalogue.copy(take)


def _unread(connection: duckdb.DuckDBPyConnection, kind: str) -> int:
    """How many trials' words are not copied yet."""
    ((trials,),) = connection.execute(f"SELECT count(*) {WAITING.format(kind=kind)}").fetchall()
    return int(trials)


def _look(connection: duckdb.DuckDBPyConnection, wanted: Wanted) -> None:
    """Find the decisions with all the words, of whatever trials."""
    holds = "".join(" AND contains(folded, lower(?))" for _ in wanted.terms)
    connection.execute(
        "CREATE TEMP TABLE hits AS SELECT rowid AS place, number, side, decision, tactical, "  # noqa: S608 # constants
        f"switch, failure FROM words.{wanted.kind} WHERE true{holds}",
        wanted.terms,
    )
    connection.execute(
        "CREATE TEMP TABLE counted AS SELECT number, tactical, switch, failure, count(*) AS times "
        "FROM hits GROUP BY ALL"
    )


def _searched(connection: duckdb.DuckDBPyConnection, wanted: Wanted, page: int) -> Found:
    _look(connection, wanted)
    where, values = wanted.where()
    (totals,) = records(
        connection,
        "SELECT coalesce(sum(times), 0)::BIGINT AS decisions, count(DISTINCT number) AS trials "  # noqa: S608 # constants
        f"FROM counted JOIN listed USING (number) WHERE {where}",
        values,
    )
    number = min(page, max(1, -(-totals["decisions"] // PAGE)))
    hits, facets = _page(connection, wanted, number), _facets(connection, wanted)
    return Found(
        hits, **totals, page=number, facets=facets, unread=_unread(connection, wanted.kind)
    )


def _page(connection: duckdb.DuckDBPyConnection, wanted: Wanted, number: int) -> list[Hit]:
    where, values = wanted.where()
    rows = records(
        connection,
        "SELECT chosen.*, time_s, text, folded FROM ("  # noqa: S608 # constants
        "SELECT place, trial_id, spec_hash, model, variant, condition, outcome, hits.side, "
        "hits.decision, tactical, switch, failure FROM hits JOIN listed USING (number) "
        f"WHERE {where} ORDER BY trial_id, spec_hash, hits.decision, hits.side "
        f"LIMIT {PAGE} OFFSET ?) AS chosen JOIN words.{wanted.kind} AS said "
        "ON said.rowid = place ORDER BY trial_id, spec_hash, chosen.decision, chosen.side",
        [*values, PAGE * (number - 1)],
    )
    folded = connection.execute("SELECT lower(unnest(?::VARCHAR[]))", [wanted.terms]).fetchall()
    terms = [term for (term,) in folded]
    return [
        Hit(row, None if row["text"] is None else snippet(row["text"], row["folded"], terms))
        for row in rows
    ]


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
