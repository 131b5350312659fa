"""Drivers: all of them in a list, and a page for each, beside the humans and perhaps another."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

from merge_runner_analysis.data.reference_data import human_counts
from merge_runner_analysis.explorer.display_text import with_minus
from merge_runner_analysis.explorer.pages.computed import computed_table
from merge_runner_analysis.explorer.pages.home import (
    KINDS,
    Driver,
    drivers_of,
    humans_by_condition,
    humans_of,
    noted,
    verdicts_of,
    with_merged,
)
from merge_runner_analysis.explorer.reading import Row
from merge_runner_analysis.explorer.scope import Scope, carried, scope_of, unmarked
from merge_runner_analysis.explorer.site import NotThere, Site
from merge_runner_analysis.explorer.views import ordered
from merge_runner_analysis.names import HUMAN
from merge_runner_analysis.tables.formats import printed
from merge_runner_analysis.verdict_words import DIFFERS, MEASURES, OPEN, SHOWN

# How attempts of a driver's trials with a prompt ended, and which model answered.
ATTEMPTS = """
SELECT served, outcome, count(*) AS times
FROM tried SEMI JOIN (FROM listed WHERE model = ? AND variant = ?) USING (number)
GROUP BY ALL ORDER BY ALL
"""

# What was sent with every prompt, as JSON.
SENT = """
SELECT any_value(coalesce(spec->'$.left.body', spec->'$.right.body'))::VARCHAR AS body
FROM listed JOIN specs USING (spec_hash) WHERE model = ? AND variant = ?
"""


def drivers_page(site: Site, asked: Mapping[str, str]) -> str:
    """All drivers with their prompts; raises NotThere."""
    bar = scope_of(site, asked)
    found, table = verdicts_of(site, bar.scope, asked)
    chosen = bar.scope.drivers or bar.drivers
    drivers = [one for one in drivers_of(site, table, bar.scope) if unmarked(one.name) in chosen]
    kinds = {kind: [one for one in drivers if one.kind == kind] for kind in KINDS}
    return site.render(
        "drivers.html",
        here="drivers",
        bar=bar,
        carried=carried(asked),
        computed=found,
        table=table,
        kinds=kinds,
        headings=KINDS,
        measures=MEASURES,
        human=humans_of(table),
    )


def driver_page(site: Site, name: str, asked: Mapping[str, str]) -> str:
    """A driver with one prompt, of ``human`` the humans; raises NotThere."""
    bar = scope_of(site, asked, "" if name == HUMAN else name)
    found, table = verdicts_of(site, bar.scope, asked)
    drivers = drivers_of(site, table, bar.scope)
    by_name = {one.name: one for one in drivers if one.prompt == bar.scope.prompt}
    own, beside = by_name.get(name), by_name.get(asked.get("with", ""))
    if own is None and name != HUMAN and table is not None:
        raise NotThere(
            f"no driver {name!r} was played with this prompt; there are: "
            f"{', '.join(by_name) or 'none'}"
        )
    first, words = "", None
    if own and own.facts and own.facts["asked"]:
        first = _first(site, own, bar.scope, asked)
        words = site.words.search(bar.scope.trials(own.name, own.prompt))
    return site.render(
        "driver.html",
        here="drivers",
        name=name,
        own=own,
        beside=beside,
        others=[one for one in by_name.values() if one is not own],
        bar=bar,
        carried=carried(asked),
        computed=found,
        table=table,
        measures=MEASURES,
        human=humans_of(table, own),
        first=first,
        parameters=_parameters(site, own) if own else "",
        found=words,
        kept=bar.scope.trials(name, bar.scope.prompt),
        summary=_summary(own) if own else "",
        attempts=_attempts(site, own) if own else [],
        accounts=_accounts(site, own, bar.scope) if own else [],
        conditions=_conditions(site, own, bar.scope),
        notes=noted([own] if own else []),
    )


def _summary(own: Driver) -> str:
    """How many of the humans' traits are shown, and how many measures are open."""
    states = [cell.values.get("state") for cell in own.cells.values()]
    traits = [
        cell.values.get("state")
        for name, cell in own.cells.items()
        if name not in {"collisions", "gap"}
    ]
    if not own.cells:
        return ""
    shown = sum(state == SHOWN or state in DIFFERS - {"unlike"} for state in traits)
    return (
        f"{shown} of {sum(bool(state) for state in traits)} human traits shown; "
        f"{states.count(OPEN)} of {sum(map(bool, states))} measures inconclusive."
    )


def _first(site: Site, own: Driver, scope: Scope, asked: Mapping[str, str]) -> str:
    """What the driver does first, by the table of first actions; empty until that is made."""
    _, table = computed_table(site, "first-action", asked, scope.sweep, scope.condition)
    told = []
    for row in table.rows if table else []:
        group = row.groups[0]
        if table and group in {f"{own.name}/{own.prompt}", HUMAN} and row.values.get("slope_ci"):
            of = printed(table, row)
            told.append(
                f"{of['driver']}: brakes in {of['brake_percent']} %, holds in {of['hold_percent']}"
                f" %, goes in {of['go_percent']} % of {of['n']}; m/s² per m/s of own relative "
                f"velocity: {of['slope']} {of['slope_ci']}."
            )
    return with_minus(" ".join(told)) if len(told) > 1 else ""


def _parameters(site: Site, own: Driver) -> str:
    """What was sent to the model beside its prompts; empty for a program."""
    (row,) = site.catalogue.ask(SENT, unmarked(own.name), own.prompt)
    body = json.loads(row["body"] or "{}")
    return ", ".join(
        f"{name} {value}" for name, value in body.items() if isinstance(value, str | int | float)
    )


def _attempts(site: Site, own: Driver) -> list[Row]:
    return site.catalogue.ask(ATTEMPTS, unmarked(own.name), own.prompt)


def _accounts(site: Site, own: Driver, scope: Scope) -> list[Row]:
    """Why the driver collided: the classes of its collisions."""
    wanted = {**scope.trials(own.name, own.prompt), "outcome": "collided"}
    return [row for row in site.catalogue.counts(wanted, "account") if row["account"]]


def _conditions(site: Site, own: Driver | None, scope: Scope) -> dict[str, Any]:
    """What the driver's trials, and the humans', come to by condition."""
    rows: dict[str, Row] = {}
    if own is not None:
        counts = site.catalogue.counts(scope.trials(own.name, own.prompt), "condition")
        rows = {row["condition"]: with_merged(row) for row in counts}
    names = ordered(rows or human_counts())
    return {
        "names": names,
        "own": [rows[name] for name in names] if rows else [],
        "humans": humans_by_condition(names),
    }
