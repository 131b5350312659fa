"""A table as data: typed columns, rows with ids, notes. Formats and ``explain`` read this alone."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from math import isnan
from typing import Literal

Kind = Literal["text", "count", "number", "percent", "p", "verdict", "interval"]
Value = str | int | float | bool | tuple[float, float] | None


@dataclass(frozen=True, slots=True)
class Column:
    """One column.

    ``meaning`` says in words what stands in it, and ``counts`` is the SQL predicate of the
    trials that its values rest on. A value may be missing without a note where ``optional``.
    ``within`` narrows the trials of its rows, also of those that name their own.
    """

    name: str
    heading: str
    kind: Kind = "text"
    digits: int = 2
    meaning: str = ""
    counts: str = "status = 'finished'"
    optional: bool = False
    within: str = ""


@dataclass(frozen=True, slots=True)
class Row:
    """One row: its readable id, the groups whose trials it rests on, values by column, a note.

    ``counts`` is the SQL predicate of its trials, where it is not that of the columns; ``printed``
    names the columns whose values are the published ones.
    """

    id: str
    groups: tuple[str, ...]
    values: Mapping[str, Value]
    note: str = ""
    counts: str = ""
    printed: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class Table:
    """A table; a missing value always comes with a note, and NaN never occurs."""

    name: str
    title: str
    columns: Sequence[Column]
    rows: Sequence[Row]
    notes: Sequence[str] = field(default_factory=tuple)
    number: str = ""

    def __post_init__(self) -> None:
        for row in self.rows:
            for column in self.columns:
                value = row.values.get(column.name)
                if isinstance(value, float) and isnan(value):
                    raise ValueError(f"{self.name}: {row.id} has NaN in {column.name}")
                if value is None and not column.optional and not row.note:
                    raise ValueError(f"{self.name}: {row.id} has no {column.name} and no note")

    @property
    def heading(self) -> str:
        """Number and title."""
        return f"{self.number}. {self.title}" if self.number else self.title
