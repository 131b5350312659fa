"""Rows of the tables ``effects``, ``levels`` and ``comparison``, as texts and marks of a page."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from math import floor, log10
from typing import Any

from merge_runner_analysis.metrics import DECIMALS
from merge_runner_analysis.tables.model import Row, Table
from merge_runner_analysis.web.marks import Mark
from merge_runner_analysis.wording import (
    ALPHA,
    METRIC_NAMES,
    TIMES,
    brackets,
    equal_p,
    money,
    number,
)

MOST_DECIMALS = 4
NO_BREAK = "\N{NO-BREAK SPACE}"
MIDDLE = Mark("", None, None, zero=50.0)  # no difference, on the axis of differences


@dataclass(frozen=True, slots=True)
class Measured(Row):
    """A row on one measure; its values are as the columns of its table say."""

    values: Mapping[str, Any]

    @property
    def metric(self) -> str:
        """Name of the metric."""
        return self.id.rpartition("/")[2]

    @property
    def name(self) -> str:
        """Label of the measure."""
        return METRIC_NAMES.get(self.metric, str(self.values["measure"]).rpartition(" (")[0])

    @property
    def unit(self) -> str:
        """Unit of a difference."""
        return str(self.values["measure"]).rpartition("(")[2].rstrip(")").replace("%", "points")

    @property
    def level(self) -> str:
        """The level: ``hurry=yes``."""
        return f"{self.values['factor']}={self.values['level']}"

    @property
    def factors(self) -> list[str]:
        """The factor, or those of an interaction."""
        return str(self.values["factor"]).split(TIMES)

    @property
    def interval(self) -> str:
        """The interval of the difference, or nothing: ``[6.06, 19.60]``."""
        ends = self.values.get("ci")
        return brackets(ends, money) if self.unit == "USD" else ends_text(ends)

    @property
    def difference(self) -> str:
        """The difference: ``+12.84 points``."""
        value = self.values["difference"]
        return f"{'+' if value > 0 else ''}{self.with_unit(value)}"

    @property
    def test(self) -> str:
        """The test: ``+12.84 points [6.06, 19.60], corrected p = 0.012``."""
        apart = f"{self.difference} {self.interval}".rstrip()
        return f"{apart}, corrected p {equal_p(self.values['p_corrected'])}"

    @property
    def is_interaction(self) -> bool:
        """True for a difference of differences."""
        return "/interaction/" in self.id

    @property
    def is_shown(self) -> bool:
        """True where the corrected p is below 5 %."""
        return is_tested(self) and self.values["p_corrected"] < ALPHA

    def amount(self, value: float) -> str:
        """Return a value of the measure, without the unit."""
        return money(value) if self.unit == "USD" else number(value)

    def with_unit(self, value: float) -> str:
        """Return a value with the unit of differences: ``4.26 points``."""
        return f"{self.amount(value)} {self.unit}"


def rows_of(table: Table) -> list[Measured]:
    """Return the rows of a table."""
    return [measured(row) for row in table.rows]


def measured(row: Row) -> Measured:
    """Return a row of a table with the texts of its measure."""
    return Measured(row.id, row.groups, row.values, row.note, untested=row.untested)


def is_tested(row: Row) -> bool:
    """Return whether a row has a p."""
    return row.values.get("p_corrected") is not None


def is_copied(row: Row) -> bool:
    """Return whether a row is a primary test that identical trials left untested."""
    return bool(row.values.get("primary")) and row.untested


def estimate_text(row: Measured, name: str) -> str:
    """Return the value of a level: ``63.00 %``."""
    return row.with_unit(row.values[name]).replace("points", "%")


def unbroken(text: str) -> str:
    """Return the text without line breaks between a number and its unit, or within intervals."""
    return re.sub(r"(?<=\d) (?=[%m]|points)|(?<=\d,) (?=[−\d])|(?<=[<=]) (?=\d)|^ ", NO_BREAK, text)


def ends_text(ends: Sequence[float] | None) -> str:
    """Return ``[0.12, 3.40]``, or nothing; an end that is not 0 does not read as 0."""
    least = min((abs(end) for end in ends or () if end), default=1.0)
    decimals = min(max(DECIMALS, -floor(log10(2 * least))), MOST_DECIMALS)
    return brackets(ends, lambda end: number(end, decimals))


def ends_of(rows: Iterable[Measured]) -> dict[str, float]:
    """Return the greatest distance from 0 of differences and their intervals, by metric."""
    ends: dict[str, float] = {}
    for row in rows:
        values = (row.values["difference"], *(row.values.get("ci") or ()))
        ends[row.metric] = max(ends.get(row.metric, 0.0), *map(abs, values))
    return ends


def difference_mark(row: Measured, end: float) -> Mark:
    """Return a difference on an axis about 0."""
    values = (row.values["difference"], *(row.values.get("ci") or ()))
    at, *ends = (round(50 + 48 * value / (end or 1.0), 2) for value in values)
    return Mark("plain", at, (ends[0], ends[1]) if ends else None, zero=50.0)
