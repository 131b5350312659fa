"""A trial's stored rows against the rows that it should have, column by column."""

from __future__ import annotations

import hashlib
from collections.abc import Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import duckdb

from merge_runner.rows import Row

TrialKey = tuple[str, str]
"""(trial_id, spec_hash)"""

# What tells the rows of a trial apart.
PLACES: dict[str, tuple[str, ...]] = {
    "trials": (),
    "states": ("step", "side"),
    "decisions": ("decision", "side"),
    "calls": ("decision", "side", "attempt"),
}
# Texts of any length are compared by their hash, so that none of them is read.
LONG: dict[str, tuple[str, ...]] = {
    "decisions": ("rationale", "prompt"),
    "calls": ("request", "reply"),
}


@dataclass(frozen=True, slots=True)
class Difference:
    """A column that is stored otherwise in ``rows`` rows of a trial, and the first of them.

    Without a column rows are missing, or are there that should not be.
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
    """Rows of one table by trial, with the names of their columns."""

    table: str
    names: tuple[str, ...]
    rows: dict[TrialKey, list[Row]]

    def differences(
        self,
        key: TrialKey,
        wanted: Iterable[Row],
        *,
        ignored: Collection[str] = (),
        tolerance: float = 0.0,
    ) -> Iterator[Difference]:
        """What a trial's stored rows have otherwise than the wanted ones."""
        stored, made = self.rows.get(key, []), [self._hashed(row) for row in wanted]
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
            places = [p for p in common if not _same(old[p][index], new[p][index], tolerance)]
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

    def _hashed(self, row: Row) -> Row:
        values = list(row)
        for name in LONG.get(self.table, ()):
            index = self.names.index(name)
            if values[index] is not None:
                values[index] = hashlib.sha256(values[index].encode()).hexdigest()
        return tuple(values)


def stored_rows(
    connection: duckdb.DuckDBPyConnection, table: str, keys: Sequence[TrialKey]
) -> Stored:
    """The rows of these trials, with the hashes of long texts in place of them."""
    hashes = ", ".join(f"sha256({name}::VARCHAR) AS {name}" for name in LONG.get(table, ()))
    result = connection.execute(
        f"SELECT *{f' REPLACE ({hashes})' if hashes else ''} FROM {table} "  # noqa: S608 # constants
        "SEMI JOIN (SELECT unnest(?) AS trial_id, unnest(?) AS spec_hash) "
        "USING (trial_id, spec_hash)",
        [[key[0] for key in keys], [key[1] for key in keys]],
    )
    names = tuple(column[0] for column in result.description or ())
    trial_id, spec_hash = names.index("trial_id"), names.index("spec_hash")
    rows: dict[TrialKey, list[Row]] = {}
    for row in result.fetchall():
        rows.setdefault((row[trial_id], row[spec_hash]), []).append(row)
    return Stored(table, names, rows)


def _same(one: Any, other: Any, tolerance: float) -> bool:  # noqa: ANN401 # any value of a table
    if one == other:
        return True
    if isinstance(one, list) and isinstance(other, list):
        return len(one) == len(other) and all(
            _same(a, b, tolerance) for a, b in zip(one, other, strict=True)
        )
    return isinstance(one, float) and isinstance(other, float) and abs(one - other) <= tolerance
