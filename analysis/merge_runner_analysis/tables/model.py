"""A table as data for output formats and ``explain``: columns, rows, notes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from math import isnan
from typing import TYPE_CHECKING, Literal

from pydantic import TypeAdapter

from merge_runner_analysis.metrics import DECIMALS
from merge_runner_analysis.wording import note_of

if TYPE_CHECKING:
    from merge_runner_analysis.grouping import Group

Kind = Literal["text", "count", "number", "percent", "p", "verdict", "interval"]
Value = str | int | float | bool | tuple[float, float] | None
# The trials of a group that a row may rest on, beside those with a value in some column of theirs.
STORED, ENDED, FINISHED = "stored", "ended", "finished"
# The trials that a verdict counts, as its measure has it.
COUNTED = "counted"


@dataclass(frozen=True, slots=True)
class Column:
    """One column.

    ``counts`` is the column of trials or calls that a share or count counts, ``rests_on`` as of a
    row. An ``optional`` value may be missing without a note; a ``noted`` column is not shown to a
    reader.
    """

    name: str
    heading: str
    kind: Kind = "text"
    meaning: str = ""
    counts: str = ""
    optional: bool = False
    noted: bool = False
    rests_on: str = ""
    digits: int = DECIMALS


Optional = partial(Column, optional=True)


def interval(name: str, meaning: str, rests_on: str = "", digits: int = DECIMALS) -> Column:
    """Return the column of a 95 % interval."""
    return Optional(name, "95 % CI", "interval", meaning, rests_on=rests_on, digits=digits)


@dataclass(frozen=True, slots=True)
class Row:
    """One row: its readable id, the groups whose trials it rests on, values by column, a note.

    ``rests_on`` says which of these: STORED, ENDED, FINISHED, or a column in which they have a
    value; empty for none. They are in these ``conditions``, if any, without ``copies`` (trial_id,
    spec_hash). Of an ``untested`` row a reader sees the note alone.
    """

    id: str
    groups: tuple[str, ...]
    values: Mapping[str, Value]
    note: str = ""
    rests_on: str = FINISHED
    conditions: tuple[str, ...] = ()
    copies: tuple[tuple[str, str], ...] = ()
    untested: bool = False


GROUP_COLUMNS = (Column("driver", "driver"), Column("setting", "prompt"))


def row_of(
    group: Group,
    values: Mapping[str, Value],
    *remarks: object,
    item: str = "",
    rests_on: str = FINISHED,
) -> Row:
    """Return a group's row, named ``o3/A2/item``; published values rest on no trials here."""
    return Row(
        f"{group.id}/{item}" if item else group.id,
        (group.id,),
        {"driver": group.label, "setting": group.setting, **values},
        note_of(*remarks),
        rests_on if group.measured else "",
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
    """Return a table as JSON text, which ``from_text`` turns back into an equal table."""
    return AS_JSON.dump_json(table).decode()


def from_text(text: str) -> Table:
    """Return the table that ``to_text`` wrote."""
    return AS_JSON.validate_json(text)
