"""What the figures have in common: sizes, how a group is named, points with intervals."""

from __future__ import annotations

import re
import textwrap

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.lines import Line2D

from merge_runner_analysis.data.reference_data import HUMAN_TRIALS
from merge_runner_analysis.data.study import Group, Study
from merge_runner_analysis.figures.panels import Array, Point
from merge_runner_analysis.figures.styles import Style

# IEEE transactions: one column and the whole page, in inches.
COLUMN_IN, PAGE_IN = 3.5, 7.16
LINE_IN = 0.12
# A character of the figures' font, as wide as the wider ones are.
CHARACTER_IN = 0.06
BREAK = "\u200b"  # a zero-width space
MISSING = "human recordings\nare not imported"


def named(group: Group) -> str:
    """A group's name in figures: ``o3/A2``, with a stand-in or a replayed human marked as such."""
    if not group.setting:
        return group.label
    return f"{group.id} ({group.said})" if group.said else group.id


def wrapped(text: str, width_in: float) -> str:
    """A name in lines no wider than this, broken at blanks or punctuation, or else anywhere."""
    marked = re.sub(r"([+/])", f"\\1{BREAK} ", text)
    lines = textwrap.wrap(marked, max(6, int(width_in / CHARACTER_IN)))
    return "\n".join(re.sub(f"{BREAK} ?", "", line) for line in lines)


def line_count(names: list[str]) -> int:
    """How many lines the longest of these names takes."""
    return max(name.count("\n") + 1 for name in names)


def velocity_text(velocity_mps: float) -> str:
    """A relative velocity as a reader sees it."""
    sign = "−" if velocity_mps < 0 else "+" if velocity_mps > 0 else ""
    return f"{sign}{abs(velocity_mps):g} m/s"


def remarks(study: Study, colour: str) -> list[Line2D]:
    """Remarks for a legend where humans are shown by something other than their own trials."""
    if study.human not in study.groups:
        return []
    if not study.human.measured:
        label = "human gap, published regression"
        return [Line2D([], [], color=colour, ls="--", lw=0.8, label=label)]
    if study.human.published_outcomes is None:
        return []
    label = f"humans in C: the {HUMAN_TRIALS} published"
    return [Line2D([], [], ls="", label=label)]


def say(axis: Axes, text: str, height: float = 0.9) -> None:
    """A remark in a panel."""
    axis.text(
        0.5, height, text, transform=axis.transAxes, ha="center", va="top", fontsize=6,
        color="#555555",
    )  # fmt: skip


def key(style: Style, label: str) -> Line2D:
    """A line of a legend."""
    return Line2D(
        [], [], color=style.colour, marker=style.marker, ms=3, lw=0.8, mfc="white", label=label
    )


def draw_traces(axis: Axes, found: list[Array], colour: str, count: int) -> None:
    """Traces of (time, value), one of ``count`` in the panel: many must not be one blot."""
    alpha = min(0.4, max(0.06, 25 / max(count, 1)))
    lines = LineCollection(found, color=colour, lw=0.4, alpha=alpha, rasterized=True)
    lines.set(capstyle="projecting", joinstyle="round")
    axis.add_collection(lines)
    axis.autoscale_view()


def letter(axis: Axes, name: str, height: float) -> None:
    """The letter of a panel, at its upper left corner."""
    axis.text(-0.02, height, name, transform=axis.transAxes, fontweight="bold", ha="right")


def draw_points(axis: Axes, found: list[Point], shift: float, style: Style) -> None:
    """Draw estimates with their intervals, ``shift`` beside their places on the axis."""
    x = np.array([p.x for p in found]) + shift
    y = np.array([p.estimate.value for p in found], dtype=float)
    low = np.array([p.estimate.low for p in found], dtype=float)
    high = np.array([p.estimate.high for p in found], dtype=float)
    axis.errorbar(
        x, y, yerr=np.nan_to_num(np.vstack([y - low, high - y])), color=style.colour,
        marker=style.marker, ms=3, lw=0.8, elinewidth=0.7, capsize=1.5, mfc="white", mew=0.8,
    )  # fmt: skip
