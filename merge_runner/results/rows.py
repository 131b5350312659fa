"""Rows of the tables (schema.sql) of a trial's record, and their comparison with stored rows."""

from __future__ import annotations

import hashlib
import json
import re
from collections import defaultdict
from collections.abc import Collection, Iterable, Iterator, Sequence
from dataclasses import fields
from datetime import datetime
from itertools import chain
from operator import attrgetter, itemgetter
from typing import Any, NamedTuple

import duckdb

from merge_runner.records import ANSWERS, Attempt, ChatRequest, Observation, Usage, is_scripted
from merge_runner.results.database import names_of
from merge_runner.trial_records import TrialRecord, TrialSpec

Row = tuple[Any, ...]
TrialKey = tuple[str, str]
"""(trial_id, spec_hash)"""

MOST_SHOWN = 60
"""Maximum characters of a differing value in a message."""
TRIALS_AT_ONCE = 32
"""Number of trials whose rows are in memory together."""

_OF_TRIALS = (
    "SEMI JOIN (SELECT unnest(?) AS trial_id, unnest(?) AS spec_hash) USING (trial_id, spec_hash)"
)
_SPANS = (
    "SELECT (trial_id, spec_hash), (min(rowid), max(rowid)) FROM {} GROUP BY trial_id, spec_hash"
)
FACTOR_TABLE = "trial_factors"
# Key columns of a row within a trial.
KEY_COLUMNS: dict[str, tuple[str, ...]] = {
    "trials": (),
    FACTOR_TABLE: ("factor",),
    "states": ("step", "side"),
    "decisions": ("decision", "side"),
    "calls": ("decision", "side", "attempt"),
}
# Fields that are adjacent columns; dataclasses.astuple would copy each value.
_usage = attrgetter(*(field.name for field in fields(Usage)))
_SURROGATE = re.compile(r"\\u[dD][89a-fA-F]|[\ud800-\udfff]")


def rows_of(record: TrialRecord) -> dict[str, list[Row]]:
    """Return the rows of a trial by table."""
    spec, key, condition = record.spec, record.spec.key, record.spec.kinematics
    trial = (
        *(*key, spec.pair, spec.source),
        *(spec.model_left, spec.model_right, spec.variant, spec.condition),
        *(condition.projected_headway_m, condition.relative_velocity_mps),
        *(spec.repetition, spec.sample_set, record.status, record.merged_first),
        *(record.end_time_s, record.error, record.scripted, spec.focal),
    )
    return {
        "trials": [trial],
        "trial_factors": list(factor_rows(spec)),
        "states": [(*key, *row) for row in record.states],
        "decisions": list(_decision_rows(record)),
        "calls": [
            call_row(key, call.request, attempt, cached=attempt.number <= call.cached_attempts)
            for call in record.calls
            for attempt in call.attempts
        ],
    }


def factor_rows(spec: TrialSpec) -> Iterator[Row]:
    """Return the rows of ``trial_factors`` of a trial."""
    return ((*spec.key, factor, level, factor in spec.words) for factor, level in spec.factors)


def _decision_rows(record: TrialRecord) -> Iterator[Row]:
    key = record.spec.key
    for row in record.decisions:
        decision, prompt = row.decision, row.decision.prompt
        yield (
            *(*key, row.number, row.time_s, row.side),
            *(decision.valid, decision.failure, decision.tactical, decision.rationale),
            None if decision.plan is None else list(decision.plan),
            list(decision.applied),
            decision.fallback,
            prompt,
            None if prompt is None else hashlib.sha256(prompt.encode()).hexdigest(),
            None if decision.reply is None else decision.reply.request.key,
            *_perceived(row.observed),
        )


def _perceived(seen: Observation | None) -> Row:
    """Return the columns of a noisy observation; NULLs: noise-free, or an unseen vehicle."""
    if seen is None:
        return (None,) * 7
    other: Row = (None,) * 4
    if seen.other_seen:
        other = (seen.relative_distance_m, seen.other_speed_mps, seen.other_acceleration_mps2)
        other = (*other, list(seen.other_speeds_mps))
    return (seen.other_seen, seen.own_position_m, seen.own_speed_mps, *other)


def call_row(key: TrialKey, request: ChatRequest, attempt: Attempt, *, cached: bool) -> Row:
    """Return the row of ``calls`` of an attempt."""
    return (
        *(request.key, *key, request.slot.side, request.slot.decision, attempt.number),
        *(request.provider, request.model, attempt.model_served, attempt.http_status),
        *(attempt.outcome, cached),
        attempt.started_at and datetime.fromisoformat(attempt.started_at).replace(tzinfo=None),
        attempt.latency_s,
        *_usage(attempt.usage),
        *(attempt.cost_usd, attempt.finish_reason, request.body, _as_json(attempt)),
        *(attempt.error, is_scripted(request, attempt), attempt.batch_id),
    )


def _as_json(attempt: Attempt) -> str | None:
    """Return a reply as JSON; a reply that is not JSON, such as HTML, becomes a JSON string.

    So does a reply that the database would refuse: with half of a surrogate pair, or nested too
    deeply. A valid answer was parsed as JSON before.
    """
    text = attempt.reply
    # Most texts need no search for half a surrogate pair.
    plain = text is None or (text.isascii() and "\\u" not in text)
    answered = attempt.http_status == 200 and attempt.outcome in ANSWERS
    if text is None or (answered and (plain or not _SURROGATE.search(text))):
        return text
    try:
        json.dumps(json.loads(text), ensure_ascii=False).encode()
    except (ValueError, RecursionError):
        return json.dumps(text.encode(errors="replace").decode())
    return text


class Difference(NamedTuple):
    """Difference between stored and expected rows of a trial.

    ``name`` is TABLE.COLUMN, or ``rows of TABLE``. ``place`` has the key columns of the first
    differing row, and ``text`` describes the difference.
    """

    name: str
    place: dict[str, Any]
    text: str


class Stored(NamedTuple):
    """Rows of one table by trial, with its columns."""

    table: str
    names: list[str]
    rows: dict[TrialKey, list[Row]]

    def named(self, key: TrialKey) -> Iterator[dict[str, Any]]:
        """Return the rows of a trial as dictionaries by column."""
        return (dict(zip(self.names, row, strict=True)) for row in self.rows.get(key, ()))

    def differences(
        self,
        key: TrialKey,
        expected: Iterable[Row],
        *,
        ignored: Collection[str] = (),
        tolerance: float = 0.0,
    ) -> Iterator[Difference]:
        """Yield the differences between a trial's stored and expected rows."""
        names, stored = KEY_COLUMNS[self.table], self.rows.get(key, [])
        at = [self.names.index(name) for name in names]
        old = {tuple(row[i] for i in at): row for row in stored}
        new = {tuple(row[i] for i in at): row for row in expected}
        unmatched = new.keys() ^ old.keys()
        if self.table == FACTOR_TABLE:  # another study may have other factors for the same trial
            unmatched -= old.keys()
        if number := len(unmatched) + len(stored) - len(old):
            yield self._difference(
                f"rows of {self.table}", min(unmatched or old), number, "are missing or too many"
            )
        common = [place for place in new if place in old and old[place] != new[place]]
        for index, name in enumerate(self.names):
            places = [p for p in common if not same_value(old[p][index], new[p][index], tolerance)]
            if places and name not in ignored:
                values = (rows[places[0]][index] for rows in (old, new))
                texts = ("NULL" if value is None else str(value) for value in values)
                was, now = (text[:MOST_SHOWN] + "..." * (len(text) > MOST_SHOWN) for text in texts)
                text = f"is {was}, and {now} replayed"
                yield self._difference(f"{self.table}.{name}", places[0], len(places), text)

    def _difference(self, name: str, first: Row, rows: int, text: str) -> Difference:
        place = dict(zip(KEY_COLUMNS[self.table], first, strict=True))
        at = f" at step {place['step']}" if "step" in place else ""
        more = f", and {rows - 1} more in the trial" if rows > 1 else ""
        return Difference(name, place, f"{name}{at} {text}{more}")


def stored_rows(
    connection: duckdb.DuckDBPyConnection,
    table: str,
    keys: Sequence[TrialKey],
    span: tuple[int, int] | None = None,
) -> Stored:
    """Return the rows of a table for these trials; an error of DuckDB if it lacks a key column."""
    named = ", ".join(f"{name} AS {name}" for name in KEY_COLUMNS[table])
    result = rows_of_trials(connection, f"* REPLACE ({named})" if named else "*", table, keys, span)
    names, rows = names_of(result), defaultdict[TrialKey, list[Row]](list)
    key = itemgetter(*map(names.index, ("trial_id", "spec_hash")))
    for row in result.fetchall():
        rows[key(row)].append(row)
    return Stored(table, names, rows)


def rows_of_trials(
    connection: duckdb.DuckDBPyConnection,
    columns: str,
    table: str,
    keys: Sequence[TrialKey],
    span: tuple[int, int] | None = None,
) -> duckdb.DuckDBPyConnection:
    """Query the rows of a table for these trials, and return the result to fetch.

    The rows of a trial are adjacent in the table. The ``span`` of their row ids is looked up first,
    so that no other rows are read.
    """
    names = [[key[0] for key in keys], [key[1] for key in keys]]
    if span is None:
        sql = f"SELECT min(rowid), max(rowid) FROM {table} {_OF_TRIALS}"  # noqa: S608 # constants
        (span,) = connection.execute(sql, names).fetchall()
    return connection.execute(
        f"SELECT {columns} FROM {table} {_OF_TRIALS} WHERE rowid BETWEEN ? AND ?",  # noqa: S608 # constants
        [*names, *span],
    )


def in_order(
    connection: duckdb.DuckDBPyConnection, keys: Collection[TrialKey]
) -> Iterator[tuple[TrialKey, dict[str, Stored]]]:
    """Yield trials with their rows of each table, in storage order.

    The rows of TRIALS_AT_ONCE trials are read together: one range of row ids in each table.
    """
    spans: dict[str, dict[TrialKey, tuple[int, int]]] = {
        table: dict(connection.execute(_SPANS.format(table)).fetchall()) for table in KEY_COLUMNS
    }
    stored = sorted(keys & spans["trials"].keys(), key=spans["trials"].__getitem__)
    for first in range(0, len(stored), TRIALS_AT_ONCE):
        chunk, tables = stored[first : first + TRIALS_AT_ONCE], {}
        for table, by_trial in spans.items():
            ends = [*chain.from_iterable(by_trial.get(key, ()) for key in chunk)] or [0]
            tables[table] = stored_rows(connection, table, chunk, (min(ends), max(ends)))
        yield from ((key, tables) for key in chunk)


def same_value(left: Any, right: Any, tolerance: float) -> bool:  # noqa: ANN401 # any value of a table
    """Return whether two table values are equal; floats, also in lists, within the tolerance."""
    if isinstance(left, list) and isinstance(right, list) and len(left) == len(right):
        return all(same_value(a, b, tolerance) for a, b in zip(left, right, strict=True))
    if not (isinstance(left, float) and isinstance(right, float)):
        return bool(left == right)
    return left == right or abs(left - right) <= tolerance
