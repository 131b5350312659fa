"""A table as data: typed columns, rows with ids, and notes.

The output formats and ``explain`` read nothing else.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from math import isnan
from typing import TYPE_CHECKING, Literal

from pydantic import TypeAdapter

if TYPE_CHECKING:
    from merge_runner_analysis.grouping import Group

Kind = Literal["text", "count", "number", "percent", "p", "verdict", "interval"]
Value = str | int | float | bool | tuple[float, float] | None
# Which trials a row rests on, in SQL over the trials of its groups.
FINISHED = "status = 'finished'"
ENDED = "status <> 'failed'"


@dataclass(frozen=True, slots=True)
class Column:
    """One column.

    ``meaning`` describes its values in words. Both are SQL conditions beside the row's: ``trials``
    of the trials that its values rest on, where these are not all of the row's, and ``counts`` of
    those that a share or a count counts. If ``optional``, a value may be missing without a
    note. One that is ``noted`` stands in the values alone: the notes say it to a reader.
    """

    name: str
    heading: str
    kind: Kind = "text"
    digits: int = 2
    meaning: str = ""
    counts: str = ""
    optional: bool = False
    noted: bool = False
    trials: str = ""


Optional = partial(Column, optional=True)


def interval(name: str, meaning: str, digits: int = 2, trials: str = "") -> Column:
    """The column of a 95 % interval."""
    return Optional(name, "95 % CI", "interval", digits, meaning, trials=trials)


@dataclass(frozen=True, slots=True)
class Row:
    """One row: its readable id, the groups whose trials it rests on, values by column, a note.

    ``counts`` is the SQL predicate for its trials, empty where it rests on none.
    """

    id: str
    groups: tuple[str, ...]
    values: Mapping[str, Value]
    note: str = ""
    counts: str = FINISHED


GROUP_COLUMNS = (Column("driver", "driver"), Column("setting", "setting"))


def row_of(
    group: Group,
    values: Mapping[str, Value],
    *remarks: str,
    item: str = "",
    counts: str = FINISHED,
) -> Row:
    """A group's row with its GROUP_COLUMNS, named ``o3/A2/item``; its note joins the remarks.

    The published values of humans rest on no trials here.
    """
    return Row(
        f"{group.id}/{item}" if item else group.id,
        (group.id,),
        {"driver": group.label, "setting": group.setting, **values},
        "; ".join(filter(None, remarks)),
        counts if group.measured else "",
    )


@dataclass(frozen=True, slots=True)
class Table:
    """A table: a missing value in a required column always has a note, and NaN never occurs."""

    name: str
    columns: Sequence[Column]
    rows: Sequence[Row]
    notes: Sequence[str] = field(default_factory=tuple)
    title: str = ""
    number: str = ""

    # NaN is not valid JSON, and a reader could not tell its cause: a missing value is None.
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


AS_JSON = TypeAdapter(Table)


def to_text(table: Table) -> str:
    """A table as JSON text, which ``from_text`` turns back into an equal table."""
    return AS_JSON.dump_json(table).decode()


def from_text(text: str) -> Table:
    """The table that ``to_text`` wrote."""
    return AS_JSON.validate_json(text)
