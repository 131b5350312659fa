"""One driver less another, as its page and the report show it: of a finished ``comparison``."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from merge_runner.records import SIDES
from merge_runner_analysis.metrics import COLLISIONS, LEFT_FIRST
from merge_runner_analysis.tables.model import Table, from_text
from merge_runner_analysis.two_drivers import LEFT_GOES_FIRST, apart, is_constant
from merge_runner_analysis.web.computing import Job
from merge_runner_analysis.web.effect_rows import (
    Measured,
    difference_mark,
    ends_of,
    estimate_text,
    rows_of,
    unbroken,
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
    rows = sorted(rows_of(table), key=lambda row: row.metric != COLLISIONS.name)
    claim, rest = apart(*names, {row.metric: row.values for row in rows}, of_left=of_left)
    seen = [
        f"{_name(row, of_left)} {row.with_unit(row.values['detectable'])}"
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


def _name(row: Measured, of_left: bool) -> str:
    if row.metric != LEFT_FIRST.name:
        return row.name
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
        gap = driver.cells.get("gap")  # each finished trial has one
        if gap and not what.startswith("k ") and gap.values["n"] == count:
            return {"cell": f"verdicts/{gap.values['row']}:n", **scope.part}
        return None

    return filter_of


def no_trials(_what: str, _count: int) -> Filter:
    """Return no filter: a report has no list of trials."""
    return None


def _difference(row: Measured, trials: tuple[TrialsOf, TrialsOf], name: str) -> Difference:
    values = row.values
    is_tested = values["difference"] is not None and not is_constant(values)
    end = ends_of([row])[row.metric] if is_tested else 0.0
    return Difference(
        capital(name),
        [_side(row, of, to) for of, to in zip(("", "_reference"), trials, strict=True)],
        unbroken(row.difference) if is_tested else "–",
        unbroken(row.interval) if is_tested else "",
        difference_mark(row, end) if is_tested and values["p_corrected"] is not None else None,
        unbroken(row.with_unit(end)),
        p_value(values["p"] if is_tested else None),
        p_value(values["p_corrected"] if is_tested else None),
        row.is_shown,
        row.note.replace(f"{values['measure']}: ", "") or SAME * is_constant(values),
    )


def _side(row: Measured, of: str, filter_of: TrialsOf) -> dict[str, Any]:
    metric = row.metric
    k, n, value = (row.values[f"{name}{of}"] for name in ("k", "n", "value"))
    text = number(None) if value is None else unbroken(estimate_text(row, f"value{of}"))
    k_trials = None if k is None else filter_of(f"k {metric}", k)
    return {"text": text, "k": k, "n": n, "k_trials": k_trials, "n_trials": filter_of(metric, n)}
