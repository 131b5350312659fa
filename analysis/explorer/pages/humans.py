"""The drivers beside the humans, in each condition of the experiment."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from analysis.explorer import views
from analysis.explorer.details import scenario_of
from analysis.explorer.pages.computed import computed
from analysis.explorer.pictures import Axis, Scale, ends_and_ticks, marker, reach
from analysis.explorer.site import Site
from analysis.figures.styles import HUMAN_STYLE, Style, driver_style
from analysis.metrics import Metric, intervals_of, shown_in
from analysis.tables.formats import notes_of, shown_value
from analysis.tables.model import Table, from_text
from merge_runner.scenarios.merge.conditions import HUMAN_CONDITIONS

HUMAN = "human"
SHAPE_WORDS = {"down": "triangle that points down"}
# Sizes in a picture, in its units.
LEFT, TOP, HEIGHT, FOOT, STEP, LEAST, ARROW = 46.0, 8.0, 120.0, 40.0, 13.0, 112.0, 3.0


# Shares of the few trials of a condition are not known to more digits.
PERCENT_DIGITS = 1


@dataclass(frozen=True, slots=True)
class Kind:
    """A row of panels: a metric as this page shows it."""

    metric: Metric

    @property
    def name(self) -> str:
        """The metric's."""
        return self.metric.name

    @property
    def heading(self) -> str:
        """``The gap``."""
        return self.metric.in_sentences[0].upper() + self.metric.in_sentences[1:]

    @property
    def meaning(self) -> str:
        """What is drawn."""
        return f"{self.metric.meaning}; intervals: {intervals_of([self.metric])}"

    @property
    def digits(self) -> int:
        """How many decimals a value has."""
        digits = self.metric.decimals
        return min(digits, PERCENT_DIGITS) if self.metric.rate else digits

    @property
    def denominators(self) -> bool:
        """Whether its table tells those who ended from all, of whom some may be undecided."""
        return self.metric.rate and self.metric.trials == "ended"


def kinds() -> list[Kind]:
    """The rows of panels, those with denominators last, and what humans have outcomes of first."""
    metrics = shown_in("humans")
    metrics.sort(key=lambda one: (one.trials == "ended", one.humans_from != "outcomes"))
    return [Kind(metric) for metric in metrics]


@dataclass(frozen=True, slots=True)
class Mark:
    """How a group is drawn."""

    style: Style
    label: str

    @property
    def word(self) -> str:
        """The shape in words."""
        return SHAPE_WORDS.get(self.style.shape, self.style.shape)


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
        values = {
            "human": next((group for group in groups if group["id"] == HUMAN), None),
            "measured": content["measured"],
            "outcomes_from": content["outcomes_from"],
            "published_trials": content["published_trials"],
            "conditions": {
                name: views.condition_text(*of) for name, of in content["conditions"].items()
            },
            "own": [name for name in content["conditions"] if name not in HUMAN_CONDITIONS],
            "published": [one["text"] for one in content["published"].values()],
            "groups": groups,
            # Their trials are listed as they were driven, and not by the condition that is shown.
            "mirrored": {group["id"] for group in groups if group["mirrored"]},
            "rules": {group["id"]: rule_text(group) for group in groups},
            "marks": marks(groups),
            "charts": [
                chart(kind, groups, list(content["conditions"]), content["published"])
                for kind in kinds()
            ],
            "collisions": {
                kind.name: collisions(groups, kind.name) for kind in kinds() if kind.denominators
            },
            "caveat": content["caveat"],
            "notes": content["notes"],
            "differences": differences(contrasts),
            "difference_notes": [
                note for note in notes_of(contrasts) if note not in content["notes"]
            ],
        }
    return site.render(
        "humans.html",
        here="humans",
        computed=found,
        in_table={metric.name for metric in shown_in("tables")},
        human_conditions=len(HUMAN_CONDITIONS),
        path=marker,
        value=value_text,
        **values,
    )


def rule_text(group: Mapping[str, Any]) -> str:
    """What counts as a collision in the trials of a group, and how often it is looked for."""
    source = HUMAN if group["id"] == HUMAN else ""
    scenario = scenario_of(source, group["scenario"])
    return f"{views.collision_text(scenario)}, looked for {1 / scenario.step_s:g} times a second"


def marks(groups: Sequence[Mapping[str, Any]]) -> dict[str, Mark]:
    """A colour and a shape for each group; humans are black."""
    found: dict[str, Mark] = {}
    models = 0
    for group in groups:
        style = HUMAN_STYLE
        if group["id"] != HUMAN:
            style = driver_style(models)
            models += 1
        found[group["id"]] = Mark(style, group["driver"])
    return found


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


def against_humans(contrasts: Table) -> Table:
    """The rows in which humans are the reference."""
    return replace(
        contrasts, rows=[row for row in contrasts.rows if row.values["reference"] == HUMAN]
    )


def differences(contrasts: Table) -> list[dict[str, Any]]:
    """The rows of differences, as printed."""
    columns = {column.name: column for column in contrasts.columns}
    return [
        {
            "row": row.id,
            "note": row.note,
            **{name: shown_value(columns[name], row.values.get(name)) for name in columns},
        }
        for row in contrasts.rows
    ]


def chart(
    kind: Kind,
    groups: Sequence[Mapping[str, Any]],
    conditions: Sequence[str],
    published: Mapping[str, Any],
) -> dict[str, Any]:
    """One row of panels: where everything is drawn, in the units of the picture.

    ``cut`` names the intervals that go on beyond the axis.
    """
    printed: dict[str, float] = published.get(kind.name, {}).get("values", {})
    labels = {group["id"]: group["driver"] for group in groups}
    known = [
        found
        for group in groups
        for of_condition in group["conditions"].values()
        if (found := of_condition.get(kind.name)) is not None and found["value"] is not None
    ]
    metric = kind.metric
    low, high, ticks = ends_and_ticks(
        *reach(known, list(printed.values())), metric.lowest, metric.highest
    )
    axis = Axis(Scale(low, high, TOP + HEIGHT, TOP), ticks)
    panel = max(LEAST, STEP * (len(groups) + 1))
    panels: list[dict[str, Any]] = []
    for i, name in enumerate(conditions):
        x0 = LEFT + i * panel
        points = []
        for j, group in enumerate(groups):
            found = group["conditions"][name].get(kind.name)
            if found is None or found["value"] is None:
                continue
            x = round(x0 + panel / 2 + STEP * (j - (len(groups) - 1) / 2), 1)
            points.append({"group": group["id"], "x": x, "of": found, **axis.placed(found, ARROW)})
        line = axis.y(printed[name]) if name in printed else None
        panels.append({"name": name, "x": round(x0, 1), "points": points, "line": line})
    return {
        "kind": kind,
        "width": round(LEFT + panel * len(conditions) + 4),
        "height": TOP + HEIGHT + FOOT,
        "top": TOP,
        "bottom": TOP + HEIGHT,
        "panel": panel,
        "ticks": [(axis.y(tick), f"{tick:g}") for tick in axis.ticks],
        "panels": panels,
        "printed": printed,
        "cut": [
            f"{labels[point['group']]} in {panel['name']}: {value_text(point['of'], kind.digits)}"
            for panel in panels
            for point in panel["points"]
            if point["arrows"]
        ],
    }


def value_text(found: Mapping[str, Any] | None, digits: int) -> str:
    """An estimate with its interval and n, for the table behind a chart."""
    if found is None or found["value"] is None:
        return "–"
    interval = ""
    if found["low"] is not None:
        interval = f" [{found['low']:.{digits}f}, {found['high']:.{digits}f}]"
    return f"{found['value']:.{digits}f}{interval}, n {found['n']}"
