"""Figure 2 of arXiv 2604.09609 for every prompt variant: a row per group, a column per panel."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from merge_runner.prompts.blocks import title_of
from merge_runner_analysis.data.study import Group, Study
from merge_runner_analysis.figures.drawing import (
    LINE_IN,
    MISSING,
    PAGE_IN,
    draw_points,
    draw_traces,
    key,
    letter,
    line_count,
    remarks,
    say,
    velocity_text,
    wrapped,
)
from merge_runner_analysis.figures.panels import (
    HUMAN_VELOCITIES_MPS,
    Point,
    deviations,
    drawn_groups,
    farthest_headway_m,
    gaps,
    left_first,
    left_traces,
    published_gap_line,
    velocities_mps,
)
from merge_runner_analysis.figures.styles import (
    BLUE,
    GREEN,
    ORANGE,
    PURPLE,
    SKY_BLUE,
    VERMILION,
    Style,
    turned,
)
from merge_runner_analysis.metrics import Bounded

# Laid out by hand: many rows of equal panels need no solver. In inches.
LABEL_IN, ROW_IN = 1.15, 0.62
LEFT_IN, RIGHT_IN, TOP_IN, BOTTOM_IN = LABEL_IN + 0.35, 0.08, 0.4, 0.62
BETWEEN_ROWS_IN, BETWEEN_COLUMNS_IN = 0.16, 0.3
# Styles for the humans' relative velocities, in their order, and those left for others.
STYLES = (Style(BLUE, "v"), Style(GREEN, "o"), Style(VERMILION, "^"))
OTHER_COLOURS, OTHER_MARKERS = (PURPLE, SKY_BLUE, ORANGE), "sDP"
Styles = dict[float, Style]
HEADINGS = (
    "left first:\nv left (m/s)",
    "left second:\nv left (m/s)",
    "P(left\nmerges first)",
    "gap at\nmerge (m)",
    "RMSE of\nspeed (m/s)",
)
XLABELS = ("time (s)", "time (s)", *["headway (m)"] * 3)
SHOWN = 0.95
PANELS = (left_first, gaps, deviations)


def figure_2_variants(study: Study) -> Figure:
    """Left speeds (A, B), who was first (C), gap (D) and speed deviation (E) of every group."""
    groups = drawn_groups(study, study.groups)
    styles = _styles(study)
    names = [_name(group) for group in groups]
    figure, axes = _panels(len(groups), max(ROW_IN, LINE_IN * line_count(names) + 0.06))
    for row, group, name in zip(axes, groups, names, strict=True):
        row[0].annotate(
            name, (0, 0.5), (-72 * (LEFT_IN - 0.05), 0), "axes fraction",
            textcoords="offset points", va="center",
        )  # fmt: skip
        for axis, first in zip(row[:2], ("left", "right"), strict=True):
            _traces(axis, study, group, first, styles)
        for axis, points in zip(row[2:], PANELS, strict=True):
            _points(axis, group, points, styles)
        if not group.measured:
            _published(row[3], styles)
    _scales(axes, groups, study)
    _headings(axes)
    _legend(figure, study, styles)
    return figure


def _styles(study: Study) -> Styles:
    """Colour and marker of each relative velocity in m/s."""
    humans = dict(zip(HUMAN_VELOCITIES_MPS, STYLES, strict=True))
    others = [velocity for velocity in velocities_mps(study) if velocity not in humans]
    own = {velocity: turned(i, OTHER_COLOURS, OTHER_MARKERS) for i, velocity in enumerate(others)}
    return {velocity: (humans | own)[velocity] for velocity in velocities_mps(study)}


def _panels(rows: int, row_in: float) -> tuple[Figure, NDArray[np.object_]]:
    """A figure of page width with ``rows`` rows of panels of equal size."""
    height_in = TOP_IN + BOTTOM_IN + rows * row_in - BETWEEN_ROWS_IN
    panel_in = (PAGE_IN - LEFT_IN - RIGHT_IN + BETWEEN_COLUMNS_IN) / len(HEADINGS)
    figure = Figure(figsize=(PAGE_IN, height_in))
    axes = figure.subplots(
        rows,
        len(HEADINGS),
        sharex="col",
        sharey="col",
        squeeze=False,
        gridspec_kw={
            "left": LEFT_IN / PAGE_IN,
            "right": 1 - RIGHT_IN / PAGE_IN,
            "top": 1 - TOP_IN / height_in,
            "bottom": BOTTOM_IN / height_in,
            "hspace": BETWEEN_ROWS_IN / (row_in - BETWEEN_ROWS_IN),
            "wspace": BETWEEN_COLUMNS_IN / (panel_in - BETWEEN_COLUMNS_IN),
        },
    )
    return figure, axes


def _name(group: Group) -> str:
    driver = wrapped(group.label, LABEL_IN)
    if not group.setting:
        return driver
    return f"{driver}\n{wrapped(title_of(group.setting), LABEL_IN)}"


def _traces(axis: Axes, study: Study, group: Group, first: str, styles: Styles) -> None:
    """The left speeds of those trials in which this side merged first."""
    parts = [left_traces(study, _part(group, velocity), first) for velocity in styles]
    count = sum(map(len, parts))
    for found, style in zip(parts, styles.values(), strict=True):
        draw_traces(axis, found, style.colour, count)
    if count:
        # The vehicle that goes first drives faster, which leaves room below its traces. The one
        # that goes second leaves room above.
        y, va = (0.04, "bottom") if first == "left" else (0.96, "top")
        axis.text(0.98, y, f"n = {count}", transform=axis.transAxes, ha="right", va=va, fontsize=6)
    else:
        say(axis, "no such trial" if group.measured else MISSING)


def _part(group: Group, velocity_mps: float) -> Group:
    return group.part(lambda trials: trials["relative_velocity_mps"] == velocity_mps)


def _points(
    axis: Axes, group: Group, points: Callable[[Group, float], list[Point]], styles: Styles
) -> None:
    """Estimates of the relative velocities, side by side."""
    found = [points(group, velocity) for velocity in styles]
    for index, (part, style) in enumerate(zip(found, styles.values(), strict=True)):
        draw_points(axis, part, 0.3 * (index - (len(styles) - 1) / 2), style)
    if group.measured and not any(found):
        say(axis, "no such trial")
    elif points is deviations and not group.measured:
        say(axis, MISSING)


def _published(axis: Axes, styles: Styles) -> None:
    """The humans' gaps as the paper's regression has them."""
    for velocity in {*styles} & {*HUMAN_VELOCITIES_MPS}:
        axis.plot(*published_gap_line(velocity), color=styles[velocity].colour, ls="--", lw=0.8)


def _scales(axes: NDArray[np.object_], groups: list[Group], study: Study) -> None:
    """One scale per quantity; a few very wide intervals must not flatten all the others."""
    speeds = [limit for axis in axes[0, :2] for limit in axis.get_ylim()]
    for axis in axes[0, :2]:
        axis.set_ylim(min(speeds), max(speeds))
    axes[0, 2].set_ylim(-0.08, 1.08)
    axes[0, 2].set_yticks([0, 0.5, 1])
    published = not all(group.measured for group in groups)
    lines = [float(y) for v in HUMAN_VELOCITIES_MPS for y in published_gap_line(v)[1] if published]
    for axis, points in zip(axes[0, 3:], PANELS[1:], strict=True):
        found = [p.estimate for g in groups for v in velocities_mps(study) for p in points(g, v)]
        if found:
            axis.set_ylim(*_limits(found, lines if points is gaps else []))
    farthest_m = farthest_headway_m(study)
    for axis in axes[0, 2:]:
        axis.set_xlim(-farthest_m - 1, farthest_m + 1)
        axis.set_xticks([-farthest_m, 0, farthest_m])


def _limits(found: list[Bounded], lines: list[float]) -> tuple[float, float]:
    """Limits that contain all values and lines, and 19 of 20 bounds of intervals."""
    values = [*lines, *(one.value for one in found if one.value is not None)]
    lows = [one.low for one in found if one.low is not None] or values
    highs = [one.high for one in found if one.high is not None] or values
    low = min(*values, float(np.quantile(lows, 1 - SHOWN)))
    high = max(*values, float(np.quantile(highs, SHOWN)))
    margin = 0.08 * (high - low) or 1.0
    return low - margin, high + margin


def _headings(axes: NDArray[np.object_]) -> None:
    for axis, heading, panel in zip(axes[0], HEADINGS, "ABCDE", strict=True):
        axis.set_title(heading)
        letter(axis, panel, 1.1)
    for axis, label in zip(axes[-1], XLABELS, strict=True):
        axis.set_xlabel(label)


def _legend(figure: Figure, study: Study, styles: Styles) -> None:
    handles = [key(style, f"Δv = {velocity_text(velocity)}") for velocity, style in styles.items()]
    handles += remarks(study, "#555555")
    figure.legend(handles=handles, loc="lower center", ncols=len(handles), frameon=False)
