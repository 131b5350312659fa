"""Drivers: all of them in a list, and a page for each, beside the humans and perhaps another."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from merge_runner_analysis.data.reference_data import human_counts
from merge_runner_analysis.explorer.conditions import ordered
from merge_runner_analysis.explorer.pages.home import (
    KINDS,
    Driver,
    drivers_of,
    humans_of,
    noted,
    verdicts_of,
)
from merge_runner_analysis.explorer.reading import Row
from merge_runner_analysis.explorer.scope import Scope, scope_of, unmarked
from merge_runner_analysis.explorer.site import NotThere, Site
from merge_runner_analysis.names import HUMAN
from merge_runner_analysis.verdict_words import DIFFERS, MEASURES, OPEN, SHOWN

# How attempts of a driver's trials with a prompt ended, and which model answered.
ATTEMPTS = """
SELECT served, outcome, sum(times)::BIGINT AS times
FROM tried SEMI JOIN (FROM listed WHERE model = ? AND variant = ?) USING (number)
GROUP BY ALL ORDER BY ALL
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
        computed=found,
        table=table,
        kinds=kinds,
        headings=KINDS,
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
    return site.render(
        "driver.html",
        here="drivers",
        name=name,
        own=own,
        beside=beside,
        others=[one for one in by_name.values() if one is not own],
        bar=bar,
        computed=found,
        table=table,
        measures=MEASURES,
        human=humans_of(table),
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


def _attempts(site: Site, own: Driver) -> list[Row]:
    return site.catalogue.ask(ATTEMPTS, unmarked(own.name), own.prompt)


def _accounts(site: Site, own: Driver, scope: Scope) -> list[Row]:
    """Why the driver collided: the classes of its collisions."""
    wanted = scope.filter(own.name, own.prompt, "collided")
    return [row for row in site.catalogue.counts(wanted, "account") if row["account"]]


def _conditions(site: Site, own: Driver | None, scope: Scope) -> dict[str, Any]:
    """What the driver's trials, or the humans', come to by condition."""
    humans = human_counts()
    if own is None:
        return {"names": list(humans), "cells": {}, "humans": humans}
    wanted = scope.filter(own.name, own.prompt)
    rows = {row["condition"]: row for row in site.catalogue.counts(wanted, "condition")}
    return {"names": ordered(rows), "cells": rows, "humans": humans}
