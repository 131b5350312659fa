"""What the figures have in common: sizes, styles, how a group is named, points with intervals."""

from __future__ import annotations

import re
import textwrap
from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.lines import Line2D

from merge_runner_analysis.data.study import Group
from merge_runner_analysis.metrics import Bounded

# IEEE transactions: one column and the whole page, in inches.
COLUMN_IN, PAGE_IN = 3.5, 7.16
LINE_IN = 0.12
# A character of the figures' font, as wide as the wider ones are.
CHARACTER_IN = 0.06
BREAK = "\u200b"  # a zero-width space
# The palette of Okabe and Ito (2008), safe for the colour-blind.
BLUE, VERMILION, GREEN, PURPLE = "#0072b2", "#d55e00", "#009e73", "#cc79a7"
SKY_BLUE, ORANGE = "#56b4e9", "#e69f00"
COLOURS = (BLUE, VERMILION, GREEN, PURPLE, SKY_BLUE, ORANGE)
MARKERS = "v^sDPX"


@dataclass(frozen=True, slots=True)
class Style:
    """A colour, and a marker as matplotlib names it."""

    colour: str
    marker: str


HUMAN_STYLE = Style("#000000", "o")


def style(number: int) -> Style:
    """A style, counted from 0; once the colours are used up, each comes with another marker."""
    turn = number + number // len(COLOURS)
    return Style(COLOURS[number % len(COLOURS)], MARKERS[turn % len(MARKERS)])


@dataclass(frozen=True, slots=True)
class Point:
    """An estimate at a place on an axis."""

    x: float
    estimate: Bounded


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


def row_height_in(names: list[str], least_in: float) -> float:
    """The height of rows with these wrapped names."""
    return max(least_in, LINE_IN * max(name.count("\n") + 1 for name in names) + 0.05)


def say(axis: Axes, text: str) -> None:
    """A remark in a panel."""
    axis.text(
        0.5, 0.9, text, transform=axis.transAxes, ha="center", va="top", fontsize=6,
        color="#555555",
    )  # fmt: skip


def key(style: Style, label: str) -> Line2D:
    """A line of a legend."""
    return Line2D(
        [], [], color=style.colour, marker=style.marker, ms=3, lw=0.8, mfc="white", label=label
    )


def draw_points(axis: Axes, points: list[Point], shift: float, style: Style) -> None:
    """Draw estimates with their intervals, ``shift`` beside their places on the axis."""
    x = np.array([p.x for p in points]) + shift
    y = np.array([p.estimate.value for p in points], dtype=float)
    low = np.array([p.estimate.low for p in points], dtype=float)
    high = np.array([p.estimate.high for p in points], dtype=float)
    axis.errorbar(
        x, y, yerr=np.nan_to_num(np.vstack([y - low, high - y])), color=style.colour,
        marker=style.marker, ms=3, lw=0.8, elinewidth=0.7, capsize=1.5, mfc="white", mew=0.8,
    )  # fmt: skip
