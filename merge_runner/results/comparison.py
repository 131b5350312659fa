"""A trial's stored rows against the rows that it should have, column by column."""

from __future__ import annotations

import hashlib
from collections.abc import Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

import duckdb

from merge_runner.results.database import names_of
from merge_runner.results.rows import Row

TrialKey = tuple[str, str]
"""(trial_id, spec_hash)"""

Span = tuple[int, int]
"""The first and the last row number."""
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


@dataclass(frozen=True, slots=True)
class Stored:
    """Rows of one table by trial, with its columns; those in ``hashed`` hold hashes of texts."""

    table: str
    names: tuple[str, ...]
    hashed: tuple[str, ...] = ()
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
    ) -> Iterator[Difference]:
        """The differences of a trial's stored rows from the wanted ones."""
        stored, made = self.rows.get(key, []), [self._as_stored(row) for row in wanted]
        at = [self.names.index(name) for name in PLACES[self.table]]
        old = {tuple(row[i] for i in at): row for row in stored}
        new = {tuple(row[i] for i in at): row for row in made}
        if odd := len(stored) - len(old) + len(old.keys() ^ new.keys()):
            first = min(old.keys() ^ new.keys() or old.keys())
            yield Difference(
                self.table, None, dict(zip(PLACES[self.table], first, strict=True)), odd
            )
        common = [place for place in new if place in old and old[place] != new[place]]
        for index, name in enumerate(self.names):
            if name in ignored:
                continue
            places = [p for p in common if not same_value(old[p][index], new[p][index], tolerance)]
            if places:
                first = places[0]
                yield Difference(
                    self.table,
                    name,
                    dict(zip(PLACES[self.table], first, strict=True)),
                    len(places),
                    old[first][index],
                    new[first][index],
                )

    def _as_stored(self, row: Row) -> Row:
        values = list(row)
        for name in self.hashed:
            index = self.names.index(name)
            if values[index] is not None:
                values[index] = hashlib.sha256(values[index].encode()).hexdigest()
        return tuple(values)


def stored_rows(
    connection: duckdb.DuckDBPyConnection,
    table: str,
    keys: Sequence[TrialKey],
    span: Span | None = None,
) -> Stored:
    """The rows of these trials, with hashes in place of long texts."""
    hashed = LONG.get(table, ())
    hashes = ", ".join(f"sha256({name}::VARCHAR) AS {name}" for name in hashed)
    columns = f"* REPLACE ({hashes})" if hashes else "*"
    result = rows_of_trials(connection, columns, table, keys, span)
    names = tuple(names_of(result))
    trial_id, spec_hash = names.index("trial_id"), names.index("spec_hash")
    stored = Stored(table, names, hashed)
    for row in result.fetchall():
        stored.rows.setdefault((row[trial_id], row[spec_hash]), []).append(row)
    return stored


def rows_of_trials(
    connection: duckdb.DuckDBPyConnection,
    columns: str,
    table: str,
    keys: Sequence[TrialKey],
    span: Span | None = None,
) -> duckdb.DuckDBPyConnection:
    """A query for the rows of these trials, to be fetched.

    A trial's rows lie together in the table. Their place is looked up first, unless it is given, so
    that no other rows are read.
    """
    names = [[key[0] for key in keys], [key[1] for key in keys]]
    first, last = (
        span
        or connection.execute(
            f"SELECT min(rowid), max(rowid) FROM {table} {_OF_THESE}",  # noqa: S608 # constants
            names,
        ).fetchall()[0]
    )
    return connection.execute(
        f"SELECT {columns} FROM {table} {_OF_THESE} WHERE rowid BETWEEN ? AND ?",  # noqa: S608 # constants
        [*names, first, last],
    )


def in_order(
    connection: duckdb.DuckDBPyConnection, keys: Iterable[TrialKey]
) -> Iterator[tuple[list[TrialKey], dict[str, Span]]]:
    """Yield trials, a few at once, and the span of their rows in each table.

    They come in the order in which they are stored, so that they are one stretch of each table.
    """
    where = {table: _spans(connection, table) for table in PLACES}
    nowhere = (0, -1)
    ordered = sorted(keys, key=lambda key: [spans.get(key, nowhere) for spans in where.values()])
    for first in range(0, len(ordered), AT_ONCE):
        some = ordered[first : first + AT_ONCE]
        stretches = {}
        for table, spans in where.items():
            there = [spans[key] for key in some if key in spans] or [nowhere]
            stretches[table] = (min(a for a, _ in there), max(b for _, b in there))
        yield some, stretches


def _spans(connection: duckdb.DuckDBPyConnection, table: str) -> dict[TrialKey, Span]:
    rows = connection.execute(
        f"SELECT trial_id, spec_hash, min(rowid), max(rowid) FROM {table} GROUP BY ALL"  # noqa: S608 # constants
    ).fetchall()
    return {(trial_id, spec_hash): (first, last) for trial_id, spec_hash, first, last in rows}


def same_value(one: Any, other: Any, tolerance: float) -> bool:  # noqa: ANN401 # any value of a table
    """Whether two values of a table are equal; numbers, even within lists, within the tolerance."""
    if one == other:
        return True
    if isinstance(one, list) and isinstance(other, list):
        return len(one) == len(other) and all(
            same_value(a, b, tolerance) for a, b in zip(one, other, strict=True)
        )
    return isinstance(one, float) and isinstance(other, float) and abs(one - other) <= tolerance
