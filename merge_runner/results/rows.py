"""A trial's record as rows of the tables (schema.sql), and these against the stored ones."""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, fields
from datetime import datetime
from operator import attrgetter, itemgetter
from typing import Any

import duckdb

from merge_runner.records import (
    Attempt,
    ChatReply,
    ChatRequest,
    FailedCall,
    Observation,
    Side,
    StateRow,
    TrialRecord,
    TrialSpec,
    Usage,
    is_scripted,
)
from merge_runner.results.database import names_of
from merge_runner.scenarios.merge.conditions import CONDITIONS

Row = tuple[Any, ...]
TrialKey = tuple[str, str]
"""(trial_id, spec_hash)"""

SHOWN = 60
"""Characters of a value that differs."""
AT_ONCE = 16
"""Trials whose rows are in memory together, without their long texts."""

_OF_THESE = (
    "SEMI JOIN (SELECT unnest(?) AS trial_id, unnest(?) AS spec_hash) USING (trial_id, spec_hash)"
)
FACTORS = "trial_factors"
# What identifies a row within a trial.
PLACES: dict[str, tuple[str, ...]] = {
    "trials": (),
    FACTORS: ("factor",),
    "states": ("step", "side"),
    "decisions": ("decision", "side"),
    "calls": ("decision", "side", "attempt"),
}
# Texts of any length are compared by their hashes, so that no long text need be read.
LONG: dict[str, tuple[str, ...]] = {
    "decisions": ("rationale", "prompt"),
    "calls": ("request", "reply"),
}
# Fields that are columns side by side; dataclasses.astuple would copy each value.
_state = attrgetter(*(field.name for field in fields(StateRow)))
_usage = attrgetter(*(field.name for field in fields(Usage)))
_SURROGATE = re.compile(r"\\u[dD][89a-fA-F]|[\ud800-\udfff]")


def rows_of(record: TrialRecord) -> dict[str, list[Row]]:
    """All rows of a trial, by table."""
    spec, condition = record.spec, CONDITIONS[record.spec.condition]
    key = (spec.trial_id, spec.spec_hash)
    trial = (
        *(*key, spec.pair, spec.source),
        *(spec.model_left, spec.model_right, spec.variant, spec.condition),
        *(condition.projected_headway_m, condition.relative_velocity_mps),
        *(spec.repetition, spec.sample_set, record.status, record.merged_first),
        *(record.end_time_s, record.error, record.scripted),
    )
    return {
        "trials": [trial],
        "trial_factors": list(factor_rows(spec)),
        "states": [(*key, *_state(row)) for row in record.states],
        "decisions": list(_decision_rows(record)),
        "calls": list(_call_rows(record)),
    }


def factor_rows(spec: TrialSpec) -> Iterator[Row]:
    """Rows of ``trial_factors``."""
    return ((spec.trial_id, spec.spec_hash, *level) for level in spec.factors)


def _decision_rows(record: TrialRecord) -> Iterator[Row]:
    for row in record.decisions:
        decision, prompt = row.decision, row.decision.prompt
        yield (
            *(record.spec.trial_id, record.spec.spec_hash, row.number, row.time_s, row.side),
            *(decision.valid, decision.failure, decision.tactical, decision.rationale),
            None if decision.plan is None else list(decision.plan),
            list(decision.applied),
            decision.fallback,
            prompt,
            None if prompt is None else hashlib.sha256(prompt.encode()).hexdigest(),
            None if decision.reply is None else decision.reply.request.key,
            *_told(row.told),
        )


def _told(told: Observation | None) -> Row:
    """What a driver was told, of the other vehicle only where it was seen; NULLs: the truth."""
    if told is None:
        return (None,) * 7
    of_itself = (told.other_seen, told.own_position_m, told.own_speed_mps)
    if not told.other_seen:
        return (*of_itself, None, None, None, None)
    of_the_other = (told.relative_distance_m, told.other_speed_mps, told.other_acceleration_mps2)
    return (*of_itself, *of_the_other, list(told.other_speeds_mps))


def _call_rows(record: TrialRecord) -> Iterator[Row]:
    """Rows of ``calls``: every attempt of every call, including failed calls."""
    key = (record.spec.trial_id, record.spec.spec_hash)
    calls: list[tuple[Side, int, ChatReply | FailedCall]] = [
        (row.side, row.number, row.decision.reply) for row in record.decisions if row.decision.reply
    ]
    calls += [(call.side, call.number, call) for call in record.failed_calls]
    for side, number, call in calls:
        for attempt in call.attempts:
            cached = attempt.number <= call.earlier
            yield call_row(*key, side, number, call.request, attempt, cached=cached)


def call_row(
    trial_id: str,
    spec_hash: str,
    side: Side,
    decision: int,
    request: ChatRequest,
    attempt: Attempt,
    *,
    cached: bool,
) -> Row:
    """The row of an attempt at a decision's call."""
    return (
        *(request.key, trial_id, spec_hash, side, decision, attempt.number),
        *(request.provider, request.model, attempt.model_served, attempt.http_status),
        *(attempt.outcome, cached),
        attempt.started_at and datetime.fromisoformat(attempt.started_at).replace(tzinfo=None),
        attempt.latency_s,
        *_usage(attempt.usage),
        *(attempt.cost_usd, attempt.finish_reason, request.body, _as_json(attempt)),
        *(attempt.error, is_scripted(request, attempt), attempt.batch_id),
    )


def _as_json(attempt: Attempt) -> str | None:
    """A reply that is not JSON, such as a proxy's HTML page, becomes a JSON string.

    So does one that the database would refuse: with half of a surrogate pair, or nested deeper than
    any honest reply. An answer was read as JSON already.
    """
    text = attempt.reply
    # Most texts have nothing that needs a search for half a pair.
    plain = text is None or (text.isascii() and "\\u" not in text)
    if text is None or (attempt.answered and (plain or not _SURROGATE.search(text))):
        return text
    try:
        json.dumps(json.loads(text), ensure_ascii=False).encode()
    except (ValueError, RecursionError):
        return json.dumps(text.encode(errors="replace").decode())
    return text


@dataclass(frozen=True, slots=True)
class Difference:
    """A column that differs in ``rows`` stored rows of a trial, and the first of these rows.

    If ``column`` is None, rows are missing or superfluous.
    """

    table: str
    column: str | None
    place: dict[str, Any]
    rows: int
    stored: object = None
    wanted: object = None

    @property
    def name(self) -> str:
        """The column's name with its table's."""
        return f"{self.table}.{self.column}" if self.column else f"rows of {self.table}"

    def __str__(self) -> str:
        at = f" at step {self.place['step']}" if "step" in self.place else ""
        more = f", and {self.rows - 1} more in the trial" if self.rows > 1 else ""
        if self.column is None:
            return f"{self.name} are missing or too many{at}{more}"
        if self.column in LONG.get(self.table, ()):
            return f"{self.name} is not what it is replayed{more}"
        values = ("NULL" if value is None else str(value) for value in (self.stored, self.wanted))
        stored, wanted = (text[:SHOWN] for text in values)
        return f"{self.name}{at} is {stored}, and {wanted} replayed{more}"


@dataclass(frozen=True, slots=True)
class Stored:
    """Rows of one table by trial, with its columns; hashes are in place of long texts."""

    table: str
    names: list[str]
    rows: dict[TrialKey, list[Row]] = field(default_factory=dict)

    def named(self, key: TrialKey) -> Iterator[dict[str, Any]]:
        """The rows of a trial, each by the names of its columns."""
        return (dict(zip(self.names, row, strict=True)) for row in self.rows.get(key, ()))

    def differences(
        self,
        key: TrialKey,
        wanted: Iterable[Row],
        *,
        ignored: Collection[str] = (),
        tolerance: float = 0.0,
        part: bool = False,
    ) -> Iterator[Difference]:
        """The differences of a trial's stored rows from the wanted ones.

        ``part`` says that those are a part of the trial's rows, so that others may be stored.
        """
        at = [self.names.index(name) for name in PLACES[self.table]]
        stored = self.rows.get(key, [])
        old = {tuple(row[i] for i in at): row for row in stored}
        new = {tuple(row[i] for i in at): self._as_stored(row) for row in wanted}
        odd = new.keys() - old.keys() if part else old.keys() ^ new.keys()
        twice = 0 if part else len(stored) - len(old)
        if odd or twice:
            place = dict(zip(PLACES[self.table], min(odd or old), strict=True))
            yield Difference(self.table, None, place, twice + len(odd))
        common = [place for place in new if place in old and old[place] != new[place]]
        for index, name in enumerate(self.names):
            places = [p for p in common if not same_value(old[p][index], new[p][index], tolerance)]
            if places and name not in ignored:
                place, first = dict(zip(PLACES[self.table], places[0], strict=True)), places[0]
                values = old[first][index], new[first][index]
                yield Difference(self.table, name, place, len(places), *values)

    def _as_stored(self, row: Row) -> Row:
        values = list(row)
        for index in map(self.names.index, LONG.get(self.table, ())):
            if values[index] is not None:
                values[index] = hashlib.sha256(values[index].encode()).hexdigest()
        return tuple(values)


def stored_rows(
    connection: duckdb.DuckDBPyConnection, table: str, keys: Sequence[TrialKey]
) -> Stored:
    """The rows of these trials, with hashes in place of long texts."""
    hashes = ", ".join(f"sha256({name}::VARCHAR) AS {name}" for name in LONG.get(table, ()))
    columns = f"* REPLACE ({hashes})" if hashes else "*"
    result = rows_of_trials(connection, columns, table, keys)
    stored = Stored(table, names_of(result))
    key = itemgetter(*map(stored.names.index, ("trial_id", "spec_hash")))
    for row in result.fetchall():
        stored.rows.setdefault(key(row), []).append(row)
    return stored


def rows_of_trials(
    connection: duckdb.DuckDBPyConnection, columns: str, table: str, keys: Sequence[TrialKey]
) -> duckdb.DuckDBPyConnection:
    """A query for the rows of these trials, to be fetched.

    A trial's rows lie together in the table. Their place is looked up first, so that no other rows
    are read.
    """
    names = [[key[0] for key in keys], [key[1] for key in keys]]
    sql = f"SELECT min(rowid), max(rowid) FROM {table} {_OF_THESE}"  # noqa: S608 # constants
    (span,) = connection.execute(sql, names).fetchall()
    return connection.execute(
        f"SELECT {columns} FROM {table} {_OF_THESE} WHERE rowid BETWEEN ? AND ?",  # noqa: S608 # constants
        [*names, *span],
    )


def in_order(
    connection: duckdb.DuckDBPyConnection, keys: Collection[TrialKey]
) -> Iterator[tuple[TrialKey, dict[str, Stored]]]:
    """Yield trials with their rows of each table, in the order in which they are stored.

    The rows of a few are read at once, which are one stretch of each table.
    """
    rows = connection.execute("SELECT trial_id, spec_hash FROM trials ORDER BY rowid").fetchall()
    stored = [key for key in rows if key in keys]
    for first in range(0, len(stored), AT_ONCE):
        some = stored[first : first + AT_ONCE]
        tables = {table: stored_rows(connection, table, some) for table in PLACES}
        yield from ((key, tables) for key in some)


def same_value(one: Any, other: Any, tolerance: float) -> bool:  # noqa: ANN401 # any value of a table
    """Whether two values of a table are equal; numbers, even within lists, within the tolerance."""
    if one == other:
        return True
    if isinstance(one, list) and isinstance(other, list):
        return len(one) == len(other) and all(
            same_value(a, b, tolerance) for a, b in zip(one, other, strict=True)
        )
    return isinstance(one, float) and isinstance(other, float) and abs(one - other) <= tolerance
