"""The study on one screen: its question, a row and a sentence on each driver, what to type next."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

from merge_runner_analysis.data.reference_data import human_counts
from merge_runner_analysis.explorer.marks import Cell, band, cells
from merge_runner_analysis.explorer.pages.computed import Computed, computed_table
from merge_runner_analysis.explorer.pages.sweep import standing_of
from merge_runner_analysis.explorer.reading import Row
from merge_runner_analysis.explorer.scope import Bar, Scope, carried, scope_of, unmarked
from merge_runner_analysis.explorer.site import Site, news_of
from merge_runner_analysis.explorer.views import ordered
from merge_runner_analysis.names import DESCRIPTIONS, HUMAN
from merge_runner_analysis.tables.model import Table
from merge_runner_analysis.verdict_words import (
    HUMANS,
    LANGUAGE_MODEL,
    MEASURES,
    MOCK,
    PROGRAM,
    TABLE,
    Values,
    by_group,
    capital,
    headline,
    sentence,
)

KINDS = {
    LANGUAGE_MODEL: ("Language models", ""),
    PROGRAM: ("Programs", "compute their plans; asked nobody"),
    MOCK: ("Mock models", "a script answered in a model's name; in no conclusion"),
}
# Where each driver's decisions were asked, as their specs name it.
ENDPOINTS = """
SELECT model, variant, any_value(spec->>'$.left.endpoint') AS endpoint
FROM listed JOIN specs USING (spec_hash) GROUP BY ALL
"""


@dataclass(frozen=True, slots=True)
class Driver:
    """A driver with a prompt: its verdicts, and what its trials come to.

    ``facts`` are counts of the list of trials, None where it has none of them.
    """

    name: str
    prompt: str
    kind: str
    cells: dict[str, Cell]
    sentence: str
    facts: Row | None
    endpoint: str
    verdicts: dict[str, Values]

    @property
    def valid_percent(self) -> float | None:
        """Valid decisions of those that were asked, in percent."""
        if self.facts is None or not self.facts["asked"]:
            return None
        return 100 * (1 - float(self.facts["invalid"]) / float(self.facts["asked"]))


def home_page(site: Site, asked: Mapping[str, str]) -> str:
    """The study; raises NotThere, and NothingNew where nothing is new since it was ``seen``."""
    standing = standing_of(site.catalogue)
    seen = news_of((standing, site.catalogue.state(), site.catalogue.held), asked.get("seen", ""))
    bar = scope_of(site, asked)
    given = {name: value for name, value in asked.items() if name != "seen"}
    found, table = verdicts_of(site, bar.scope, given)
    drivers = drivers_of(site, table, bar.scope)
    shown = [one for one in drivers if _is_shown(one, bar.scope)]
    return site.render(
        "home.html",
        here="index",
        standing=standing,
        seen=seen,
        descriptions=[row["description"] for row in site.catalogue.ask(DESCRIPTIONS)],
        bar=bar,
        carried=carried(asked),
        computed=found,
        table=table,
        kinds={kind: [one for one in shown if one.kind == kind] for kind in KINDS},
        headings=KINDS,
        measures=MEASURES,
        human=humans_of(table),
        headline=headline(
            {one.name: one.verdicts for one in shown if one.kind == LANGUAGE_MODEL and one.cells}
        ),
        other_prompts=[name for name, _ in bar.prompts if name != bar.scope.prompt],
        notes=noted(shown),
        conditions=_conditions(site, bar, shown),
    )


def verdicts_of(
    site: Site, scope: Scope, asked: Mapping[str, str]
) -> tuple[Computed, Table | None]:
    """The table of verdicts of a scope, once it is computed."""
    part = scope.sweep, scope.condition
    found, table = computed_table(site, TABLE, asked, *part)
    # While a run goes on, a new one would soon be old again.
    if table and found.older and not any(run["followed"] for run in standing_of(site.catalogue)):
        found, table = computed_table(site, TABLE, {**asked, "anew": "1"}, *part)
    return found, table


def humans_of(table: Table | None, own: Driver | None = None) -> dict[str, Any]:
    """The humans' cells by measure, where their bands lie, and which humans they are.

    Beside a driver they are those that it is compared with, in its conditions.
    """
    found = by_group(table.rows).get(HUMAN, {}) if table else {}
    label = str(next(iter(found.values()))["driver"]) if found else HUMAN
    for name, values in own.verdicts.items() if own and own.cells else ():
        beside = {"estimate": values.get("human"), "ci": values.get("human_ci")}
        found[name] = {**found[name], **beside}
    return {
        "about": label.partition("(")[2].rstrip(")") or "990 trials of nine pairs, as published",
        "cells": cells(found),
        "bands": {name: band(measure, found.get(name, {})) for name, measure in MEASURES.items()},
    }


def drivers_of(site: Site, table: Table | None, scope: Scope) -> list[Driver]:
    """Every driver and prompt with trials in a scope; without a table their facts alone."""
    counts = site.catalogue.counts(scope.trials(), "model", "variant", "who")
    facts = {(row["model"], row["variant"]): row for row in counts if row["who"] != "humans"}
    endpoints = {
        (row["model"], row["variant"]): row["endpoint"] or ""
        for row in site.catalogue.ask(ENDPOINTS)
    }
    if table is None:
        return [
            Driver(name, prompt, _kind(row), {}, "", row, endpoints.get((name, prompt), ""), {})
            for (name, prompt), row in facts.items()
        ]
    drivers = []
    for group, verdicts in by_group(table.rows).items():
        first = next(iter(verdicts.values()))
        if first["kind"] == HUMANS:
            continue
        prompt = str(first["setting"])
        name = group.removesuffix(f"/{prompt}")
        key = unmarked(name), prompt
        drivers.append(
            Driver(
                name,
                prompt,
                str(first["kind"]),
                cells(verdicts),
                sentence(verdicts),
                facts.get(key),
                endpoints.get(key, ""),
                verdicts,
            )
        )
    return drivers


def _kind(row: Row) -> str:
    """What kind of driver the list of trials tells."""
    if row["who"] == "stand-ins":
        return MOCK
    return LANGUAGE_MODEL if row["asked"] else PROGRAM


def _is_shown(one: Driver, scope: Scope) -> bool:
    chosen = not scope.drivers or unmarked(one.name) in scope.drivers
    return one.prompt == scope.prompt and chosen


def noted(drivers: list[Driver]) -> list[tuple[str, str, str]]:
    """What is to be known of a number: driver, measure and note, each at its cell (†)."""
    return [
        (one.name, cell.measure.trait, capital(str(cell.values["note"])))
        for one in drivers
        for cell in one.cells.values()
        if cell.values["note"]
    ]


def _conditions(site: Site, bar: Bar, shown: list[Driver]) -> dict[str, Any]:
    """Collisions by driver and condition, as the list of trials counts them, beside the humans'."""
    rows = site.catalogue.counts(bar.scope.trials(), "model", "variant", "condition")
    counted = {(row["model"], row["variant"], row["condition"]): row for row in rows}
    names = ordered({name for _, _, name in counted})
    return {
        "names": names,
        "humans": humans_by_condition(names),
        "imported": bool(site.catalogue.counts({"who": "humans"}, "who")),
        "rows": [
            (one, [counted.get((unmarked(one.name), one.prompt, name)) for name in names])
            for one in shown
        ],
    }


def humans_by_condition(names: Iterable[str]) -> list[Row | None]:
    """The published counts of conditions; None for one that no human drove."""
    known = {name: with_merged(counts._asdict()) for name, counts in human_counts().items()}
    return [known.get(name) for name in names]


def with_merged(row: Row) -> Row:
    """Counts of trials with how many merged, and without other counts how many ended."""
    merged = row["left_first"] + row["right_first"]
    return {"ended": merged + row["collided"], **row, "merged": merged}
