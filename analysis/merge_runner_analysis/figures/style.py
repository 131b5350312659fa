"""Style of all figures: sizes, colours, markers, fonts, and how estimates are drawn."""

from __future__ import annotations

import re
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.markers import TICKDOWN
from numpy.typing import NDArray

from merge_runner_analysis.stats.estimate import Estimate

# IEEE transactions: the whole page, in inches.
PAGE_IN = 7.16
# The height of a line of the figures' font, with what is between two.
LINE_IN = 0.12
# The palette of Okabe and Ito (2008), safe for the colour-blind.
COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#56b4e9", "#e69f00")
MARKERS = "v^sDPX"
GREY = "#555555"
Style = dict[str, Any]  # of lines with markers, as matplotlib has it
LINES: Style = {"ms": 3, "lw": 0.8, "mfc": "white"}
# These settings are fixed, so that equal input gives equal files.
SETTINGS: Any = {
    "font.size": 7,
    "axes.titlesize": 7,
    "axes.titley": 1.0,  # no panel has ticks at its top, which titles would be moved away from
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.linewidth": 0.6,
    "pdf.fonttype": 42,
    "text.parse_math": False,  # a dollar sign in a name does not start a formula
    "svg.hashsalt": "merge-runner",
    "savefig.dpi": 300,
}
NO_GRID: NDArray[Any] = np.empty((0, 0), dtype=object)
Points = list[tuple[float, Estimate]]  # estimates at their places on an axis


def style(number: int) -> Style:
    """Return a style, counted from 0; used-up colours come again, each with another marker."""
    marker = MARKERS[(number + number // len(COLOURS)) % len(MARKERS)]
    return LINES | {"color": COLOURS[number % len(COLOURS)], "marker": marker}


def wrapped(text: str, width: int) -> str:
    """Return a name in lines of limited length, broken at blanks or punctuation if any."""
    lines = re.findall(rf".{{1,{width}}}(?:(?<=[ +/-])|(?= )|$)|.{{1,{width}}}", text)
    return "\n".join(line.strip() for line in lines)


def choose_ticks(*axes: Axis) -> None:
    """Choose the ticks once: to draw takes a third less."""
    for axis in axes:
        low, high = axis.get_view_interval()
        ticks = [tick for tick in axis.get_majorticklocs() if low <= tick <= high]
        axis.set_ticks(ticks, axis.get_major_formatter().format_ticks(ticks))


def place(figure: Figure, grid: NDArray[Any] = NO_GRID) -> None:
    """Lay a figure out once: matplotlib would do so at each drawing, and draw it once more.

    The inner panels of a ``grid`` with shared scales are aligned with the outer ones. The ticks of
    an x axis that has no labels are one line: each axis takes as long to draw as all else.
    """
    inner = grid[1:, 1:]
    for panel in inner.flat:
        panel.set_in_layout(False)
    engine = figure.get_layout_engine()
    assert engine is not None
    engine.execute(figure)
    figure.set_layout_engine(None)
    for (row, column), panel in np.ndenumerate(inner):
        above, left = (other.get_position() for other in (grid[0, column + 1], grid[row + 1, 0]))
        panel.set_position((above.x0, left.y0, above.width, left.height))
    look: Style = {"ls": "", "color": "black", "marker": TICKDOWN, "clip_on": False}
    look |= {"ms": mpl.rcParams["xtick.major.size"], "mew": mpl.rcParams["xtick.major.width"]}
    for panel in grid[:-1].flat:
        ticks, at = panel.xaxis.get_majorticklocs(), panel.get_xaxis_transform("tick1")
        panel.add_artist(Line2D(ticks, 0 * ticks, transform=at, **look))
        panel.xaxis.set_visible(False)


def draw_points(
    axis: Axes, points: Points, shift: float, style: Style, *, horizontal: bool = False
) -> None:
    """Draw estimates with their intervals, ``shift`` beside their places on the axis."""
    rows = [
        (place + shift, estimate.value, estimate.low, estimate.high) for place, estimate in points
    ]
    places, values, low, high = np.array(rows, dtype=float).reshape(-1, 4).T
    # Each interval is a stroke with a cap at both ends: ``errorbar`` takes three times as long.
    ends = np.column_stack([low, high, np.full_like(low, np.nan)]).ravel()
    caps: Style = {"ms": 3, "mew": 0.8, "marker": "|" if horizontal else "_"}
    strokes: Style = {"lw": 0.7, "solid_capstyle": "butt", "color": style["color"], **caps}
    marks = style | {"mew": 0.8}
    for x, y, look in ((np.repeat(places, 3), ends, strokes), (places, values, marks)):
        axis.plot(*((y, x) if horizontal else (x, y)), **look)
