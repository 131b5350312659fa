"""One driver less another, as its page and the report show it: of a finished ``comparison``."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from merge_runner.records import SIDES
from merge_runner_analysis.headlines import LEFT_GOES_FIRST, apart, is_constant
from merge_runner_analysis.metrics import COLLISIONS, LEFT_FIRST
from merge_runner_analysis.tables.model import Row, Table, from_text
from merge_runner_analysis.web.computing import Job
from merge_runner_analysis.web.effect_rows import (
    amount,
    difference_mark,
    ends_of,
    interval_text,
    is_shown,
    metric_of,
    name_of,
    unbroken,
    unit_of,
)
from merge_runner_analysis.web.judged import Driver
from merge_runner_analysis.web.marks import Mark
from merge_runner_analysis.web.names import short_names
from merge_runner_analysis.web.scope import Scope
from merge_runner_analysis.web.site import Site
from merge_runner_analysis.wording import capital, number, p_value

SAME = "the same in all trials of both: nothing to test"
# The trials behind a count, as a filter of their list; None where no filter keeps just these.
Filter = dict[str, Any] | None
TrialsOf = Callable[[str, int], Filter]
"""From a metric, or ``k METRIC``, and its number of trials to their filter."""


@dataclass(frozen=True, slots=True)
class Difference:
    """A measure of both drivers; ``mark`` is on an axis that ends at ``end`` on both sides.

    ``sides`` have the value of each, the trials that it counts, and their filters.
    """

    name: str
    sides: list[dict[str, Any]]
    difference: str
    interval: str
    mark: Mark | None
    end: str
    p: str
    p_corrected: str
    is_shown: bool
    note: str


@dataclass(frozen=True, slots=True)
class Comparison:
    """The claim on two drivers, what else there is to say, and all measures."""

    names: tuple[str, str]
    claim: str
    rest: str
    rows: list[Difference]
    corrected: str
    could: str


def compared(
    site: Site, first: Driver, second: Driver, scope: Scope
) -> tuple[Job, bool, Comparison | None]:
    """Compare two drivers: return the job, whether to wait for it, and the result.

    A job without a result is waited for, even if it ends meanwhile.
    """
    groups = (f"{driver.name}/{driver.prompt}" for driver in (first, second))
    named = short_names([first.name, second.name])
    job = site.computed(("comparison", *groups, scope.sweep, scope.condition))
    if (content := job.content) is None:
        return job, True, None
    trials = trials_of(first, scope), trials_of(second, scope)
    table, names = from_text(content["table"]), (named[first.name], named[second.name])
    egos = [of.facts[f"ego_merged_{side}"] for of in (first, second) if of.facts for side in SIDES]
    return job, False, comparison_of(table, names, trials, of_left=not any(egos))


def comparison_of(
    table: Table, names: tuple[str, str], trials: tuple[TrialsOf, TrialsOf], *, of_left: bool
) -> Comparison | None:
    """Return the comparison of two drivers; None where one of them is not judged.

    Who goes first is that ``of_left`` vehicles where all drivers met copies of their own.
    """
    if not table.rows:
        return None
    # The most visible measure is the first.
    rows = sorted(table.rows, key=lambda row: metric_of(row) != COLLISIONS.name)
    claim, rest = apart(*names, {metric_of(row): row.values for row in rows}, of_left=of_left)
    seen = [
        f"{_name(row, of_left)} {_with_unit(row, 'detectable')}"
        for row in rows
        if row.values["detectable"] is not None and not is_constant(row.values)
    ]
    return Comparison(
        names,
        unbroken(claim),
        unbroken(rest),
        [_difference(row, trials, _name(row, of_left)) for row in rows],
        table.notes[0],
        unbroken("; ".join(seen)),
    )


def _name(row: Row, of_left: bool) -> str:
    if metric_of(row) != LEFT_FIRST.name:
        return name_of(row)
    return LEFT_GOES_FIRST if of_left else "goes first, before its opponent"


def trials_of(driver: Driver, scope: Scope) -> TrialsOf:
    """Return a function from a count to the filter that keeps exactly its trials."""
    every, facts = scope.trials(driver.name, driver.prompt), driver.facts or {}

    def filter_of(what: str, count: int) -> Filter:
        named = {
            f"k {COLLISIONS.name}": ("collided", {"outcome": "collided"}),
            f"k {LEFT_FIRST.name}": ("left_first", {"outcome": "left first"}),
        }
        field, more = named.get(what, ("trials", {}))
        if facts.get(field) == count:
            return every | more
        # A finished trial has a gap, and an ended one is in the row of crashes.
        for cell in driver.cells.values():
            if what[:2] != "k " and cell.values["n"] == count and cell.measure.name == "gap":
                return {"cell": f"verdicts/{cell.values['row']}:n", **scope.part}
        return None

    return filter_of


def no_trials(_what: str, _count: int) -> Filter:
    """Return no filter: a report has no list of trials."""
    return None


def _difference(row: Row, trials: tuple[TrialsOf, TrialsOf], name: str) -> Difference:
    values: Any = row.values
    is_tested = values["difference"] is not None and not is_constant(values)
    end = ends_of([row])[metric_of(row)] if is_tested else 0.0
    return Difference(
        capital(name),
        [_side(row, of, to) for of, to in zip(("", "_reference"), trials, strict=True)],
        unbroken(_with_unit(row, "difference", sign="+")) if is_tested else "–",
        unbroken(interval_text(row)) if is_tested else "",
        difference_mark(row, end) if is_tested and values["p_corrected"] is not None else None,
        unbroken(f"{amount(row, end)} {unit_of(row)}"),
        p_value(values["p"] if is_tested else None),
        p_value(values["p_corrected"] if is_tested else None),
        is_shown(row),
        row.note.replace(f"{values['measure']}: ", "") or SAME * is_constant(values),
    )


def _side(row: Row, of: str, filter_of: TrialsOf) -> dict[str, Any]:
    values: Any = row.values
    metric, k, n, value = metric_of(row), *(values[f"{name}{of}"] for name in ("k", "n", "value"))
    unit = unit_of(row).replace("points", "%")
    text = number(None) if value is None else unbroken(f"{amount(row, value)} {unit}")
    k_trials = None if k is None else filter_of(f"k {metric}", k)
    return {"text": text, "k": k, "n": n, "k_trials": k_trials, "n_trials": filter_of(metric, n)}


def _with_unit(row: Row, name: str, sign: str = "") -> str:
    values: Any = row.values
    plus = sign if values[name] > 0 else ""
    return f"{plus}{amount(row, values[name])} {unit_of(row)}"
