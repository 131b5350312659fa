"""Charts of groups over conditions: a small panel a condition, a mark with its interval a group.

Templates draw them with the macros of ``_charts.html``, which differences use, too.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any
from urllib.parse import quote

from merge_runner_analysis.explorer.analysis_worker import FACTORS
from merge_runner_analysis.explorer.pictures import Axis, reach
from merge_runner_analysis.explorer.urls import Links
from merge_runner_analysis.explorer.views import condition_text
from merge_runner_analysis.figures.styles import COLOURS, HUMAN_STYLE, Style, driver_style
from merge_runner_analysis.metrics import Metric, intervals_of, shown_in
from merge_runner_analysis.names import HUMAN

SHAPE_WORDS = {"down": "triangle that points down"}
# Shapes of lines, which have no inside.
HOLLOW = ("cross", "plus")
# Sizes in a panel, in its units.
LEFT, RIGHT, TOP, HEIGHT, FOOT, STEP, LEAST, ARROW = 30.0, 3.0, 8.0, 120.0, 38.0, 13.0, 88.0, 3.0
# Shares of the few trials of a condition are not known to more digits.
PERCENT_DIGITS = 1


@dataclass(frozen=True, slots=True)
class Kind:
    """A chart's metric, as a page shows it."""

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


@dataclass(frozen=True, slots=True)
class Mark:
    """How a group is drawn."""

    style: Style
    label: str

    @property
    def word(self) -> str:
        """The shape in words."""
        return SHAPE_WORDS.get(self.style.shape, self.style.shape)

    @property
    def tint(self) -> str:
        """The class of its colour, which a dark page shows lighter; humans have that of the ink."""
        known = self.style.colour in COLOURS
        return f"tint-{COLOURS.index(self.style.colour)}" if known else "tint-ink"

    @property
    def hollow(self) -> bool:
        """Whether its shape has no inside."""
        return self.style.shape in HOLLOW


def drawn(
    at: Links, content: Mapping[str, Any], kinds: Iterable[Kind], most: int | None = None
) -> dict[str, Any]:
    """What templates need to draw groups beside the humans, the first ``most`` or all of them."""
    groups = content["groups"][:most]
    by_id = {group["id"]: group for group in groups}
    return {
        "human": by_id.get(HUMAN),
        "measured": content["measured"],
        "conditions": {name: condition_text(*of) for name, of in content["conditions"].items()},
        "published": [one["text"] for one in content["published"].values()],
        "groups": groups,
        "undrawn": len(content["groups"]) - len(groups),
        "marks": marks(groups),
        "charts": [
            chart(kind, groups, content["conditions"], content["published"]) for kind in kinds
        ],
        "behind": lambda group, *of: behind(at, by_id[group], *of),
        "value": value_text,
    }


def marks(groups: Iterable[Mapping[str, Any]]) -> dict[str, Mark]:
    """A colour and a shape for each group; humans are black."""
    found: dict[str, Mark] = {}
    models = 0
    for group in groups:
        style = HUMAN_STYLE
        if group["id"] != HUMAN:
            style = driver_style(models)
            models += 1
        found[group["id"]] = Mark(style, group["label"])
    return found


def chart(
    kind: Kind,
    groups: Sequence[Mapping[str, Any]],
    conditions: Iterable[str],
    published: Mapping[str, Any],
) -> dict[str, Any]:
    """A panel for each condition: where everything is drawn, in the units of the panel.

    ``cut``: an interval goes on beyond the axis.
    """
    printed: dict[str, float] = published.get(kind.name, {}).get("values", {})
    known = [
        found
        for group in groups
        for of_condition in group["conditions"].values()
        if (found := of_condition.get(kind.name)) is not None and found["value"] is not None
    ]
    metric = kind.metric
    axis = Axis.of(
        reach(known, list(printed.values())), (TOP + HEIGHT, TOP), metric.lowest, metric.highest
    )
    wide = max(LEAST, STEP * (len(groups) + 1))
    panels: list[dict[str, Any]] = []
    for name in conditions:
        points = []
        for j, group in enumerate(groups):
            found = group["conditions"].get(name, {}).get(kind.name)
            if found is None or found["value"] is None:
                continue
            x = round(LEFT + wide / 2 + STEP * (j - (len(groups) - 1) / 2), 1)
            points.append({"group": group["id"], "x": x, "of": found, **axis.placed(found, ARROW)})
        line = axis.y(printed[name]) if name in printed else None
        panels.append({"name": name, "points": points, "line": line})
    return {
        "kind": kind,
        "width": LEFT + wide + RIGHT,
        "height": TOP + HEIGHT + FOOT,
        "left": LEFT,
        "right": LEFT + wide,
        "axis": axis,
        "panels": panels,
        "printed": printed,
        "cut": any(point["arrows"] for panel in panels for point in panel["points"]),
    }


def value_text(found: Mapping[str, Any] | None, digits: int) -> str:
    """An estimate with its interval and n, for the table behind a chart."""
    if found is None or found["value"] is None:
        return "–"
    interval = ""
    if found["low"] is not None:
        interval = f" [{found['low']:.{digits}f}, {found['high']:.{digits}f}]"
    return f"{found['value']:.{digits}f}{interval}, n {found['n']}"


def behind(at: Links, group: Mapping[str, Any], condition: str, measure: str) -> str:
    """The address of the trials of a group behind a measure in a condition; empty without such.

    ``table`` says whose rows the group is: that of Table VII, or that of the levels of factors.
    """
    if not group["measured"]:
        return ""
    if group["table"] == FACTORS:
        address = at.cell(FACTORS, f"{group['id']}/{measure}", "n")
    else:
        there = any(metric.name == measure for metric in shown_in("tables"))
        address = at.cell(group["table"], group["id"], measure if there else "n")
    # Mirrored trials are listed as they were driven, and not by the condition that is shown.
    if group["mirrored"] or not address:
        return address
    return f"{address}&condition={quote(condition)}"
