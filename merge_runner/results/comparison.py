"""A trial's stored rows against the rows that it should have, column by column."""

from __future__ import annotations

import hashlib
from collections.abc import Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from operator import itemgetter
from typing import Any

import duckdb

from merge_runner.results.database import names_of
from merge_runner.results.rows import Row

TrialKey = tuple[str, str]
"""(trial_id, spec_hash)"""

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
