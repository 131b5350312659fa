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

    ``meaning`` describes its values in words. ``counts`` is the column of the trials, or of their
    calls, that a share or a count counts, and ``rests_on`` is as of a row, where its values rest on
    other trials. If ``optional``, a value may be missing without a note. One that is ``noted``
    stands in the values alone: the notes say it to a reader. ``digits`` are decimals.
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

    ``rests_on`` says which of these: STORED, ENDED, FINISHED, or the column in which they have a
    value; empty where it rests on none. They are in these ``conditions``, if there are any, and
    not among the ``copies`` of others (trial_id, spec_hash). An ``untested`` one has no value, and
    its note says why: a reader sees the note alone.
    """

    id: str
    groups: tuple[str, ...]
    values: Mapping[str, Value]
    note: str = ""
    rests_on: str = FINISHED
    conditions: tuple[str, ...] = ()
    copies: tuple[tuple[str, str], ...] = ()
    untested: bool = False


GROUP_COLUMNS = (Column("driver", "driver"), Column("setting", "setting"))


def row_of(
    group: Group,
    values: Mapping[str, Value],
    *remarks: object,
    item: str = "",
    rests_on: str = FINISHED,
) -> Row:
    """Return a group's row with its GROUP_COLUMNS, named ``o3/A2/item``, and the joined remarks.

    The published values of humans rest on no trials here.
    """
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
