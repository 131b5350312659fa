"""The drivers beside the humans, in each condition of the experiment."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

from analysis.explorer import views
from analysis.explorer.analysis_worker import HUMAN
from analysis.explorer.charts import Kind, drawn
from analysis.explorer.details import scenario_of
from analysis.explorer.pages.computed import computed
from analysis.explorer.pictures import marker
from analysis.explorer.site import Site
from analysis.metrics import BOXES, shown_in
from analysis.tables.formats import notes_of, printed
from analysis.tables.model import Table, from_text
from merge_runner.scenarios.merge.conditions import HUMAN_CONDITIONS


def kinds() -> list[Kind]:
    """The rows of panels, those with denominators last, and what humans have outcomes of first."""
    metrics = shown_in("humans")
    metrics.sort(key=lambda one: (one.trials == "ended", one.humans_from != "outcomes"))
    return [Kind(metric) for metric in metrics]


def humans_page(site: Site, asked: Mapping[str, str]) -> str:
    """Small multiples over the conditions, one row a measure, and the differences."""
    # Before and after an import of humans it is another page, and not an older one.
    (humans,) = site.catalogue.ask("SELECT count(*) AS n FROM listed WHERE source = 'human'")
    found = computed(site, ("humans", str(humans["n"])), asked)
    values: dict[str, Any] = {"own": []}
    if found.result is not None:
        content = found.result.content
        groups = content["groups"]
        contrasts = against_humans(from_text(content["tables"][0]))
        values = drawn(site.at, content, kinds()) | {
            "outcomes_from": content["outcomes_from"],
            "published_trials": content["published_trials"],
            "rules": {group["id"]: rule_text(group) for group in groups},
            "collisions": {
                kind.name: collisions(groups, kind.name) for kind in kinds() if kind.denominators
            },
            "human_collisions": human_collisions(groups),
            "caveat": content["caveat"],
            "notes": content["notes"],
            "differences": [(row.id, printed(contrasts, row)) for row in contrasts.rows],
            "difference_notes": [
                note for note in notes_of(contrasts) if note not in content["notes"]
            ],
        }
    return site.render(
        "humans.html",
        here="humans",
        computed=found,
        human_conditions=len(HUMAN_CONDITIONS),
        path=marker,
        **values,
    )


def rule_text(group: Mapping[str, Any]) -> str:
    """What counts as a collision in the trials of a group, and how often it is looked for."""
    source = HUMAN if group["id"] == HUMAN else ""
    scenario = scenario_of(source, group["scenario"])
    return f"{views.collision_text(scenario)}, looked for {1 / scenario.step_s:g} times a second"


def collisions(groups: Sequence[Mapping[str, Any]], rule: str) -> list[dict[str, Any]]:
    """Collided, decided and all trials of each group, by condition and together.

    A group for which this rule is not known has no row.
    """
    rows = []
    for group in groups:
        cells: dict[str, tuple[int, int, int]] = {
            name: (found[rule]["k"], found[rule]["n"], found[rule]["all"])
            for name, found in group["conditions"].items()
            if rule in found
        }
        if not cells:
            continue
        k, ended, every = (sum(cell[i] for cell in cells.values()) for i in range(3))
        rows.append({"group": group["id"], "cells": cells, "total": (k, ended, every)})
    return rows


def human_collisions(groups: Sequence[Mapping[str, Any]]) -> dict[str, str]:
    """The human collisions in each condition of the experiment, in words."""
    rows = [row for row in collisions(groups, BOXES.name) if row["group"] == HUMAN]
    return {
        name: f"human {k} of {ended}"
        for row in rows
        for name, (k, ended, _) in row["cells"].items()
        if name in HUMAN_CONDITIONS
    }


def against_humans(contrasts: Table) -> Table:
    """The rows in which humans are the reference."""
    return replace(
        contrasts, rows=[row for row in contrasts.rows if row.values.get("reference") == HUMAN]
    )
