"""Drivers of a scope: their verdicts beside the humans', and counts of their trials."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from merge_runner.config import ScenarioConfig
from merge_runner_analysis.headlines import sentence
from merge_runner_analysis.published import HUMAN, human_counts
from merge_runner_analysis.tables.model import Table
from merge_runner_analysis.web.marks import Cell, band, cells, measures_of
from merge_runner_analysis.web.phrases import local_server, ordered
from merge_runner_analysis.web.reading import Row
from merge_runner_analysis.web.scope import Bar, Scope, carried, unmarked
from merge_runner_analysis.web.site import Site
from merge_runner_analysis.wording import (
    HUMANS,
    LANGUAGE_MODEL,
    MOCK,
    NO_CRASH_YET,
    PROGRAM,
    TABLE,
    by_group,
    capital,
    crash_text,
)

KINDS = {
    LANGUAGE_MODEL: ("Language models", ""),
    PROGRAM: ("Programs", "compute their plans; asked nobody"),
    MOCK: ("Mock models", "a script answered in a model's name; in no conclusion"),
}
BY_DIFFERENCE = "difference"  # an order of conditions
# Where each driver's decisions were asked, and what was sent with them, as the specs say it.
ASKED = """
SELECT model, variant, coalesce(any_value(spec->>'$.left.endpoint'), '') AS endpoint,
    any_value(coalesce(spec->'$.left.body', spec->'$.right.body'))::VARCHAR AS body
FROM listed JOIN specs USING (spec_hash) GROUP BY ALL
"""
# The collision rules by which drivers with prompts were played; $2 is the default one.
RULES = """
SELECT coalesce(spec->>'$.scenario.collision_rule', $2) AS rule,
    list_sort(list(DISTINCT coalesce((spec->>'$.scenario.step_s')::DOUBLE, $3))) AS steps_s
FROM listed LEFT JOIN specs USING (spec_hash)
WHERE list_contains($1::VARCHAR[], model || '/' || variant) GROUP BY rule ORDER BY rule
"""


@dataclass(frozen=True, slots=True)
class Driver:
    """A driver with a prompt: its verdicts, and counts of its trials.

    ``facts`` are counts of the list of trials, None where it has none of them; ``parameters``
    are sent with each request to its model.
    """

    name: str
    prompt: str
    kind: str
    cells: dict[str, Cell]
    sentence: str
    facts: Row | None
    endpoint: str
    parameters: str

    @property
    def local(self) -> str:
        """Label of a server on this machine; empty for any other."""
        return local_server(self.endpoint)


def judged(site: Site, bar: Bar, params: Mapping[str, str]) -> tuple[list[Driver], dict[str, Any]]:
    """Return the drivers of a scope, and the values of every page that shows their verdicts."""
    job, table = site.table(TABLE, bar.scope.sweep, bar.scope.condition)
    return drivers_of(site, table, bar.scope), {
        "bar": bar,
        "carried": carried(params),
        "computed": job,
        "table": table,
        "headings": KINDS,
        "human": humans_of(table),
        "measures": measures_of(table.rows if table else ()),
        "imported": site.trial_index.has_humans,
    }


def humans_of(table: Table | None, driver: Driver | None = None) -> dict[str, Any]:
    """Return the humans' cells and bands by measure, and a label of their trials.

    With a driver, they are the humans in its conditions.
    """
    rows = table.rows if table else ()
    verdicts, measures = by_group(rows).get(HUMAN, {}), measures_of(rows)
    label = str(next(iter(verdicts.values()))["driver"]) if verdicts else HUMAN
    for name, cell in driver.cells.items() if driver else ():
        compared = {"estimate": cell.values.get("human"), "ci": cell.values.get("human_ci")}
        verdicts[name] = {**verdicts[name], **compared}
    return {
        "about": label.partition("(")[2].rstrip(")") or "990 trials of nine pairs, as published",
        "cells": cells(verdicts, measures),
        "bands": {
            name: band(measure, verdicts.get(name, {})) for name, measure in measures.items()
        },
    }


def drivers_of(site: Site, table: Table | None, scope: Scope) -> list[Driver]:
    """Return every driver and prompt with trials in a scope; without a table their facts alone."""
    counts = site.trial_index.counts(scope.trials(), "model", "variant", "who")
    facts = {(row["model"], row["variant"]): row for row in counts if row["who"] != "humans"}
    specs = {(row["model"], row["variant"]): row for row in site.trial_index.ask(ASKED)}
    groups = by_group(table.rows) if table else {"/".join(key): {} for key in facts}
    drivers, measures = [], measures_of(table.rows if table else ())
    for group, verdicts in groups.items():
        name, _, prompt = group.rpartition("/")
        of, spec = (rows.get((unmarked(name), prompt)) for rows in (facts, specs))
        usual = LANGUAGE_MODEL if of and of["asked"] else PROGRAM
        usual = MOCK if of and of["who"] == "mocks" else usual
        kind = next((str(values["kind"]) for values in verdicts.values()), usual)
        if kind == HUMANS:
            continue
        body = json.loads((spec and spec["body"]) or "{}").items()
        sent = ", ".join(
            f"{key} {value}" for key, value in body if isinstance(value, str | int | float)
        )
        text, endpoint = sentence(verdicts) if verdicts else "", spec["endpoint"] if spec else ""
        of_driver = cells(verdicts, measures)
        drivers.append(Driver(name, prompt, kind, of_driver, text, of, endpoint, sent))
    return drivers


def by_kind(drivers: Sequence[Driver]) -> dict[str, list[Driver]]:
    """Return drivers by kind."""
    return {kind: [driver for driver in drivers if driver.kind == kind] for kind in KINDS}


def noted(
    drivers: Sequence[Driver], headings: Mapping[str, str], without: Mapping[str, str] | None = None
) -> list[tuple[list[str], str, str]]:
    """Return the notes on numbers of the measures with a heading: drivers, heading and note.

    A measure ``without`` situations for it has one note, which is given.
    """
    names: dict[tuple[str, str], list[str]] = {}
    for driver in drivers:
        for name, heading in headings.items():
            values = driver.cells[name].values if name in driver.cells else {}
            if note := (without or {}).get(name) or values.get("note"):
                names.setdefault((heading, capital(str(note))), []).append(driver.name)
    return [(of, heading, note) for (heading, note), of in names.items()]


def by_condition(
    site: Site, scope: Scope, drivers: Sequence[Driver], order: str = ""
) -> dict[str, Any]:
    """Return counts by condition, of the drivers' trials and of the humans' as published.

    ``crash`` is the drivers' collision rule in words, and ``no_crash_yet`` says how trials can be
    crashes by people's rule alone. A count is None if a condition was not driven. Without a driver
    the conditions are the humans'. In the order BY_DIFFERENCE the one in
    which a driver's share of crashes is furthest from people's comes first.
    """
    rows = site.trial_index.counts(scope.trials(), "model", "variant", "condition")
    counted = {(row["model"], row["variant"], row["condition"]): _merged(row) for row in rows}
    of = [(driver, (unmarked(driver.name), driver.prompt)) for driver in drivers]
    known = {name: _merged(counts._asdict()) for name, counts in human_counts().items()}
    played = {name for *key, name in counted if tuple(key) in [driver for _, driver in of]}
    names = ordered(played or known)
    if order == BY_DIFFERENCE:
        in_it = {name: [counted.get((*key, name)) for _, key in of] for name in names}
        names.sort(key=lambda name: _apart(known.get(name), in_it[name]), reverse=True)
    played_by = ["/".join(key) for _, key in of]
    default = ScenarioConfig()
    rules = site.trial_index.ask(RULES, played_by, default.collision_rule, default.step_s)
    return {
        "names": names,
        "by_difference": order == BY_DIFFERENCE,
        "no_crash_yet": [NO_CRASH_YET[row["rule"]] for row in rules if row["rule"] in NO_CRASH_YET],
        "crash": crash_text([(row["rule"], row["steps_s"]) for row in rules]),
        "humans": [known.get(name) for name in names],
        "rows": [(driver, [counted.get((*key, name)) for name in names]) for driver, key in of],
    }


def _apart(human: Row | None, drivers: Sequence[Row | None]) -> float:
    """Return the largest difference of a driver's share of crashes from people's; -1 for none."""
    if human is None:
        return -1.0
    shares = [of["collided"] / of["ended"] for of in drivers if of and of["ended"]]
    people = human["collided"] / human["ended"]
    return max((abs(share - people) for share in shares), default=-1.0)


def _merged(row: Row) -> Row:
    """Add to counts of trials how many merged, and where it is missing how many ended."""
    merged = row["left_first"] + row["right_first"]
    return {"ended": merged + row["collided"], **row, "merged": merged}
