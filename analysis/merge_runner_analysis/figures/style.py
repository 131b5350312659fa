"""What all figures share: sizes, colours, markers, the fonts; and estimates as they draw them."""

from __future__ import annotations

import re
from collections.abc import Iterable
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.text import Text
from numpy.typing import NDArray

from merge_runner_analysis.stats.estimate import Estimate

# IEEE transactions: the whole page, in inches.
PAGE_IN = 7.16
# The height of a line of the figures' font, with what is between two.
LINE_IN = 0.12
# Below a panel: the labels of its ticks and its own; on the right of all: half a tick's label.
X_LABELS_IN, RIGHT_IN = 0.42, 0.13
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
Points = list[tuple[float, Estimate]]  # estimates at their places on an axis


def style(number: int) -> Style:
    """Return a style, counted from 0; used-up colours come again, each with another marker."""
    marker = MARKERS[(number + number // len(COLOURS)) % len(MARKERS)]
    return LINES | {"color": COLOURS[number % len(COLOURS)], "marker": marker}


def wrapped(text: str, width: int) -> str:
    """Return a name in lines of so many characters, broken at blanks or punctuation if any."""
    lines = re.findall(rf".{{1,{width}}}(?:(?<=[ +/-])|(?= )|$)|.{{1,{width}}}", text)
    return "\n".join(line.strip() for line in lines)


def place_panels(
    figure: Figure,
    axes: NDArray[np.object_],
    names: Iterable[Text],
    around_in: tuple[float, float],
    between_in: tuple[float, float],
) -> None:
    """Place panels above the legends, on the right of names as wide as they are.

    ``around_in`` is between names and panels, and above these; ``between_in`` is across and down.
    A layout engine measures every text of every panel for this, which takes as long as to draw.
    """
    down, across = axes.shape
    width_in, height_in = figure.get_size_inches()
    names_in = max((name.get_window_extent().width / figure.dpi for name in names), default=0.0)
    legends_in = sum(key.get_window_extent().height / figure.dpi for key in figure.legends)
    left_in, bottom_in = names_in + around_in[0], legends_in + X_LABELS_IN
    panel_in = (width_in - left_in - RIGHT_IN - between_in[0] * (across - 1)) / across
    high_in = (height_in - around_in[1] - bottom_in - between_in[1] * (down - 1)) / down
    figure.subplots_adjust(
        left=left_in / width_in,
        right=1 - RIGHT_IN / width_in,
        bottom=bottom_in / height_in,
        top=1 - around_in[1] / height_in,
        wspace=between_in[0] / panel_in,
        hspace=between_in[1] / high_in,
    )
    for axis in (part for panel in axes.ravel().tolist() for part in (panel.xaxis, panel.yaxis)):
        if not axis.get_label_text():
            axis.set_label_coords(0, 0)  # else its place is sought beside the labels of the ticks


def draw_points(axis: Axes, points: Points, shift: float, style: Style) -> None:
    """Draw estimates with their intervals, ``shift`` beside their places on the axis."""
    rows = [(x + shift, one.value, one.low, one.high) for x, one in points]
    x, y, low, high = np.array(rows, dtype=float).reshape(-1, 4).T
    errors = np.nan_to_num(np.vstack([y - low, high - y]))
    axis.errorbar(x, y, yerr=errors, elinewidth=0.7, capsize=1.5, mew=0.8, **style)
