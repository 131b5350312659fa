"""The drivers beside the humans, in each condition of the experiment."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from math import ceil, floor, log10
from statistics import quantiles
from typing import Any

from analysis.explorer import views
from analysis.explorer.details import scenario_of
from analysis.explorer.pages.computed import computed
from analysis.explorer.site import Site
from analysis.figures.styles import HUMAN_STYLE, Style, driver_style
from analysis.metrics import Metric, intervals_of, shown_in
from analysis.tables.formats import notes_of, shown_value
from analysis.tables.model import Table, from_text
from merge_runner.scenarios.merge.conditions import HUMAN_CONDITIONS

HUMAN = "human"
SHAPE_WORDS = {"down": "triangle that points down"}
# Of a picture, in its units.
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

    group: str
    style: Style
    label: str

    @property
    def word(self) -> str:
        """The shape in words."""
        return SHAPE_WORDS.get(self.style.shape, self.style.shape)


def humans_page(site: Site, asked: Mapping[str, str], *, patient: bool = False) -> str:
    """Small multiples over the conditions, one row a measure, and the differences."""
    # Before and after an import of humans it is another page, and not an older one.
    (humans,) = site.catalogue.ask("SELECT count(*) AS n FROM listed WHERE source = 'human'")
    found = computed(site, ("humans", str(humans["n"])), asked, patient=patient)
    values: dict[str, Any] = {"own": []}
    if found.result is not None:
        content = found.result.content
        groups = content["groups"]
        contrasts = against_humans(from_text(content["tables"][0]))
        values = {
            "human": next((group for group in groups if group["id"] == HUMAN), None),
            "measured": content["measured"],
            "outcomes_from": content["outcomes_from"],
            "conditions": {
                name: views.condition_text(*of) for name, of in content["conditions"].items()
            },
            "own": [name for name in content["conditions"] if name not in HUMAN_CONDITIONS],
            "published": [one["text"] for one in content["published"].values()],
            "groups": groups,
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
        path=marker,
        value=value_text,
        **values,
    )


def rule_text(group: Mapping[str, Any]) -> str:
    """What is taken for a collision in the trials of a group, and how often it is looked for."""
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
        found[group["id"]] = Mark(group["id"], style, group["driver"])
    return found


def collisions(groups: Sequence[Mapping[str, Any]], rule: str) -> list[dict[str, Any]]:
    """Collided, decided and all trials of each group, by condition and together.

    A group that this rule is not known of has no row.
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
    axis = Axis(*scale(kind, *reach(known, list(printed.values()))))
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
            points.append({"group": group["id"], "x": x, "of": found, **axis.placed(found)})
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


@dataclass(frozen=True, slots=True)
class Axis:
    """The values at the bottom and the top of a row of panels, and those of its ticks."""

    low: float
    high: float
    ticks: Sequence[float]

    def y(self, value: float) -> float:
        """Where a value is drawn: at the edge if it lies beyond it."""
        inside = min(max(value, self.low), self.high)
        return round(TOP + HEIGHT * (1 - (inside - self.low) / (self.high - self.low)), 1)

    def placed(self, found: Mapping[str, Any]) -> dict[str, Any]:
        """Where an estimate is drawn, and the ends of its interval with arrows where it goes on."""
        at, low, high = {"y": self.y(found["value"])}, found["low"], found["high"]
        if low is None:
            return {**at, "ends": None, "arrows": []}
        arrows = [("down", TOP + HEIGHT - ARROW)] if low < self.low else []
        arrows += [("triangle", TOP + ARROW)] if high > self.high else []
        return {**at, "ends": (self.y(low), self.y(high)), "arrows": arrows}


def reach(estimates: Sequence[Mapping[str, Any]], printed: Sequence[float]) -> tuple[float, float]:
    """What an axis has to show: every value, and of the intervals what is not far out.

    Far out is, as Tukey draws it, what lies beyond the quartiles of all that could be shown by more
    than 1.5 times their distance: an interval of two or three trials may be ten times as long.
    """
    values = [*printed, *(found["value"] for found in estimates)]
    ends = [found[end] for found in estimates for end in ("low", "high") if found[end] is not None]
    if len(values) < 2:
        return min([*values, *ends], default=0.0), max([*values, *ends], default=1.0)
    first, _, third = quantiles([*values, *ends], n=4, method="inclusive")
    beyond = 1.5 * (third - first)
    low = max(min([*values, *ends]), first - beyond)
    high = min(max([*values, *ends]), third + beyond)
    return min([low, *values]), max([high, *values])


def scale(kind: Kind, low: float, high: float) -> tuple[float, float, list[float]]:
    """Both ends of an axis, and its ticks: round steps, with 0 in it."""
    lowest, highest = kind.metric.lowest, kind.metric.highest
    low = min(low, 0.0) if lowest is None else lowest
    high = max(high, 0.0) if highest is None else highest
    high = high if high > low else low + 1.0
    rough = (high - low) / 4
    size = 10.0 ** floor(log10(rough))
    step = next(size * m for m in (1, 2, 2.5, 5, 10) if size * m >= rough * 0.999)
    first, last = floor(low / step + 1e-9), ceil(high / step - 1e-9)
    last = max(last, first + 1)
    return first * step, last * step, [round(i * step, 6) for i in range(first, last + 1)]


def marker(shape: str, x: float, y: float, r: float = 4.2) -> str:
    """A shape about a point, as a path."""
    corners: dict[str, list[tuple[float, float]]] = {
        "square": [(-1, -1), (1, -1), (1, 1), (-1, 1)],
        "triangle": [(0, -1.2), (1.15, 0.9), (-1.15, 0.9)],
        "down": [(0, 1.2), (1.15, -0.9), (-1.15, -0.9)],
        "diamond": [(0, -1.35), (1.35, 0), (0, 1.35), (-1.35, 0)],
    }
    if shape in corners:
        points = [f"{x + r * 0.9 * dx:.1f} {y + r * 0.9 * dy:.1f}" for dx, dy in corners[shape]]
        return f"M{' L'.join(points)}Z"
    if shape == "cross":
        return (
            f"M{x - r:.1f} {y - r:.1f} L{x + r:.1f} {y + r:.1f} "
            f"M{x - r:.1f} {y + r:.1f} L{x + r:.1f} {y - r:.1f}"
        )
    if shape == "plus":
        return f"M{x - r:.1f} {y:.1f} H{x + r:.1f} M{x:.1f} {y - r:.1f} V{y + r:.1f}"
    return f"M{x - r:.1f} {y:.1f} a{r} {r} 0 1 0 {2 * r:.1f} 0 a{r} {r} 0 1 0 {-2 * r:.1f} 0Z"


def value_text(found: Mapping[str, Any] | None, digits: int) -> str:
    """An estimate with its interval and n, for the table behind a chart."""
    if found is None or found["value"] is None:
        return "–"
    interval = ""
    if found["low"] is not None:
        interval = f" [{found['low']:.{digits}f}, {found['high']:.{digits}f}]"
    return f"{found['value']:.{digits}f}{interval}, n {found['n']}"
