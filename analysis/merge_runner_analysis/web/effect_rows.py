"""Rows of the tables ``effects``, ``levels`` and ``comparison``, as texts and marks of a page."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from math import floor, log10
from typing import Any

from merge_runner_analysis.metrics import DECIMALS
from merge_runner_analysis.tables.model import Row
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


def unbroken(text: str) -> str:
    """Return the text without line breaks between a number and its unit, or within intervals."""
    return re.sub(r"(?<=\d) (?=[%m]|points)|(?<=\d,) (?=[−\d])|(?<=[<=]) (?=\d)|^ ", NO_BREAK, text)


def value_of(row: Row, name: str) -> float:
    """Return a value that is not NULL, as a number."""
    value: Any = row.values[name]
    return float(value)


def count_of(row: Row, name: str) -> int:
    """Return a count that is not NULL."""
    return int(value_of(row, name))


def interval_of(row: Row) -> tuple[float, float] | None:
    """Return both ends of the interval, if there is one."""
    ends = row.values.get("ci")
    return ends if isinstance(ends, tuple) else None


def metric_of(row: Row) -> str:
    """Return the name of an effect's metric."""
    return row.id.rpartition("/")[2]


def name_of(row: Row) -> str:
    """Return the label of an effect's measure."""
    return METRIC_NAMES.get(metric_of(row), str(row.values["measure"]).rpartition(" (")[0])


def unit_of(row: Row) -> str:
    """Return the unit of a difference."""
    return str(row.values["measure"]).rpartition("(")[2].rstrip(")").replace("%", "points")


def estimate_text(row: Row, name: str) -> str:
    """Return the value of a level: ``63.00 %``."""
    return f"{amount(row, value_of(row, name))} {unit_of(row).replace('points', '%')}"


def amount(row: Row, value: float) -> str:
    """Return a value of an effect's measure, without the unit."""
    return money(value) if unit_of(row) == "USD" else number(value)


def interval_text(row: Row) -> str:
    """Return ``[6.06, 19.60]``, or nothing."""
    if unit_of(row) == "USD":
        return brackets(interval_of(row), money)
    return ends_text(interval_of(row))


def ends_text(ends: Sequence[float] | None) -> str:
    """Return ``[0.12, 3.40]``, or nothing; an end that is not 0 does not read as 0."""
    least = min((abs(end) for end in ends or () if end), default=1.0)
    decimals = min(max(DECIMALS, -floor(log10(2 * least))), MOST_DECIMALS)
    return brackets(ends, lambda end: number(end, decimals))


def test_text(row: Row) -> str:
    """Return ``+12.84 points [6.06, 19.60], corrected p = 0.012``."""
    apart = f"{difference_text(row)} {unit_of(row)} {interval_text(row)}".rstrip()
    return f"{apart}, corrected p {equal_p(value_of(row, 'p_corrected'))}"


def difference_text(row: Row) -> str:
    """Return ``+12.84``."""
    value = value_of(row, "difference")
    return f"{'+' if value > 0 else ''}{amount(row, value)}"


def level_text(row: Row) -> str:
    """Return ``hurry=yes``."""
    return f"{row.values['factor']}={row.values['level']}"


def is_interaction(row: Row) -> bool:
    """Return whether a row is a difference of differences."""
    return "/interaction/" in row.id


def is_copied(row: Row) -> bool:
    """Return whether a row is a primary test that identical trials left untested."""
    return bool(row.values.get("primary")) and row.untested


def is_none_or_all(row: Row) -> bool:
    """Return whether a share is 0 % at both levels, or 100 % at both."""
    values = {row.values.get(name) for name in ("estimate", "estimate_reference")}
    return unit_of(row) == "points" and values in ({0.0}, {100.0})


def is_tested(row: Row) -> bool:
    """Return whether a row has a p."""
    return row.values.get("p_corrected") is not None


def is_shown(row: Row) -> bool:
    """Return whether a row's corrected p is below 5 %."""
    return is_tested(row) and value_of(row, "p_corrected") < ALPHA


def factors_of(row: Row) -> set[str]:
    """Return the factor of a level, or the factors of an interaction."""
    return {*str(row.values["factor"]).split(TIMES)}


def ends_of(rows: Iterable[Row]) -> dict[str, float]:
    """Return the greatest distance from 0 of differences and their intervals, by metric."""
    ends: dict[str, float] = {}
    for row in rows:
        values = (value_of(row, "difference"), *(interval_of(row) or ()))
        ends[metric_of(row)] = max(ends.get(metric_of(row), 0.0), *map(abs, values))
    return ends


def difference_mark(row: Row, end: float) -> Mark:
    """Return a difference on an axis about 0."""
    values = (value_of(row, "difference"), *(interval_of(row) or ()))
    at, *ends = (round(50 + 48 * value / (end or 1.0), 2) for value in values)
    return Mark("plain", at, (ends[0], ends[1]) if ends else None, zero=50.0)
