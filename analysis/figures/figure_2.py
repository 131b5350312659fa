"""Figure 2 of arXiv 2604.09609: a row per driver and prompt, a column per panel."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from numpy.typing import NDArray

from merge_runner.prompts.blocks import title_of
from merge_runner.scenarios.merge.conditions import HUMAN_CONDITIONS
from merge_runner_analysis.data.reference_data import HUMAN_TRIALS, published
from merge_runner_analysis.data.study import Group, Study, of_trials
from merge_runner_analysis.figures.drawing import (
    PAGE_IN,
    Point,
    Style,
    draw_points,
    key,
    row_height_in,
    say,
    style,
    wrapped,
)
from merge_runner_analysis.metrics import Bounded
from merge_runner_analysis.names import HUMAN
from merge_runner_analysis.stats.intervals import Estimate, mean, proportion
from merge_runner_analysis.stats.regressions import gap_design

Array = NDArray[np.float64]
# Laid out by hand: many rows of equal panels need no solver. In inches.
LABEL_IN, ROW_IN = 1.15, 0.62
# A few rows share this height, each of at most the other.
FEW_ROWS_IN, HIGHEST_ROW_IN = 4.4, 1.1
LEFT_IN, RIGHT_IN, TOP_IN, BOTTOM_IN = LABEL_IN + 0.35, 0.08, 0.4, 0.62
BETWEEN_ROWS_IN, BETWEEN_COLUMNS_IN = 0.16, 0.3
# One row a finished trial: the ego's speeds.
EGO_SPEEDS = """
SELECT trial_id, spec_hash, list(time_s ORDER BY step) AS time_s,
    list(velocity_mps ORDER BY step) AS velocity_mps
FROM states JOIN trial_drivers USING (trial_id, spec_hash)
SEMI JOIN (FROM trials WHERE status = 'finished') USING (trial_id, spec_hash)
WHERE time_s >= 0 AND side = ego GROUP BY ALL ORDER BY ALL
"""
HUMAN_VELOCITIES_MPS = sorted({c.relative_velocity_mps for c in HUMAN_CONDITIONS.values()})
Styles = dict[float, Style]  # of relative velocities in m/s
HEADINGS = (
    "left first:\nv left (m/s)",
    "left second:\nv left (m/s)",
    "P(left\nmerges first)",
    "gap at\nmerge (m)",
    "RMSE of\nspeed (m/s)",
)
XLABELS = ("time (s)", "time (s)", *["headway (m)"] * 3)
MISSING = "human recordings\nare not imported"
# The share of bounds of intervals that a scale shows.
SHOWN = 0.95


def figure_2(study: Study, chosen: list[Group]) -> Figure:
    """Left speeds (A, B), who was first (C), gap (D) and speed deviation (E) of these groups."""
    # Humans drove in conditions, too, that no driver of this study did.
    groups = [
        group.part(lambda trials: trials["condition"].isin(study.conditions)) for group in chosen
    ]
    velocities = sorted({velocity for _, velocity in study.conditions.values()})
    styles = {velocity: style(number) for number, velocity in enumerate(velocities)}
    names = [_name(group) for group in groups]
    figure, axes = _panels(names)
    for row, group, name in zip(axes, groups, names, strict=False):
        row[0].annotate(
            name, (0, 0.5), (-72 * (LEFT_IN - 0.05), 0), "axes fraction",
            textcoords="offset points", va="center",
        )  # fmt: skip
        for axis, first in zip(row[:2], ("left", "right"), strict=True):
            _draw_traces(axis, study, group, first, styles)
        for axis, summary in zip(row[2:], SUMMARIES, strict=True):
            _draw_estimates(axis, group, summary, styles)
            if group.setting and groups[0].driver == HUMAN:
                _draw_humans(axis, groups[0], summary, styles)
    _scale(axes, groups, study, velocities)
    for axis, heading, panel in zip(axes[0], HEADINGS, "ABCDE", strict=True):
        axis.set_title(heading)
        axis.text(-0.02, 1.1, panel, transform=axis.transAxes, fontweight="bold", ha="right")
    for axis, label in zip(axes[-1], XLABELS, strict=True):
        axis.set_xlabel(label)
    handles = [key(styles[v], f"Δv = {_velocity_text(v)}") for v in velocities]
    handles += _human_keys(study)
    figure.legend(handles=handles, loc="lower center", ncols=len(handles), frameon=False)
    return figure


def left_first(trials: pd.DataFrame) -> Estimate:
    """Panel C: how often the left vehicle merges first."""
    known = trials["merged_first"].dropna()
    return proportion(int((known == "left").sum()), len(known))


def gap(trials: pd.DataFrame) -> Estimate:
    """Panel D: mean gap in m."""
    return mean(trials["gap_m"].to_numpy(float))


def deviation(trials: pd.DataFrame) -> Estimate:
    """Panel E: mean RMSE of the speed in m/s, two values per trial."""
    return mean(trials[["rmse_left_mps", "rmse_right_mps"]].to_numpy(float).ravel())


Summary = Callable[[pd.DataFrame], Estimate]
SUMMARIES: tuple[Summary, ...] = (left_first, gap, deviation)


def points(group: Group, velocity_mps: float, summary: Summary) -> list[Point]:
    """A summary of the finished trials of each condition with this velocity, by headway in m."""
    if summary is not left_first and not group.measured:
        return []
    trials = group.outcomes if summary is left_first else group.trials
    chosen = trials[
        (trials["status"] == "finished") & (trials["relative_velocity_mps"] == velocity_mps)
    ]
    found = (
        Point(headway_m, summary(rows))
        for (headway_m, _), rows in chosen.groupby(["projected_headway_m", "condition"])
    )
    return [point for point in found if point.estimate.value is not None]


def left_traces(study: Study, group: Group, first: str) -> dict[float, list[Array]]:
    """Panels A and B: times in s and left speeds in m/s, (n, 2), where ``first`` merged first.

    By relative velocity. Of two different drivers the left one is the ego, as everywhere here.
    """
    if not group.measured:
        return {}
    found: dict[float, list[Array]] = {}
    for velocity, trials in group.finished.groupby("relative_velocity_mps"):
        rows = of_trials(study.read(EGO_SPEEDS), trials[trials["merged_first"] == first])
        times, speeds = rows["time_s"], rows["velocity_mps"]
        found[float(velocity)] = [
            np.column_stack(trace) for trace in zip(times, speeds, strict=True)
        ]
    return found


def published_gap_line(velocity_mps: float) -> tuple[Array, Array]:
    """The human regression of the gap as the paper prints it: headways and gaps in m.

    The line spans the headways of the humans' conditions, whatever other conditions were driven.
    """
    farthest_m = max(abs(one.projected_headway_m) for one in HUMAN_CONDITIONS.values())
    headway = np.linspace(-farthest_m, farthest_m, 81)
    terms = published("paper_gap").query("driver == 'human'")["b"].to_numpy(float)
    return headway, gap_design(headway, np.full_like(headway, velocity_mps)) @ terms


def _name(group: Group) -> str:
    driver = wrapped(group.label, LABEL_IN)
    if not group.setting:
        return driver
    return f"{driver}\n{wrapped(title_of(group.setting), LABEL_IN)}"


def _velocity_text(velocity_mps: float) -> str:
    sign = "−" if velocity_mps < 0 else "+" if velocity_mps > 0 else ""
    return f"{sign}{abs(velocity_mps):g} m/s"


def _panels(names: list[str]) -> tuple[Figure, NDArray[np.object_]]:
    """A figure of page width with a row of panels of equal size for each name."""
    rows = max(len(names), 1)
    row_in = row_height_in([*names, ""], max(ROW_IN, min(HIGHEST_ROW_IN, FEW_ROWS_IN / rows)))
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


def _draw_traces(axis: Axes, study: Study, group: Group, first: str, styles: Styles) -> None:
    """The left speeds of those trials in which this side merged first."""
    traces = left_traces(study, group, first)
    parts = [traces.get(velocity, []) for velocity in styles]
    count = sum(map(len, parts))
    if not count:
        say(axis, "no such trial" if group.measured else MISSING)
        return
    for part, look in zip(parts, styles.values(), strict=True):
        # Many traces must not be one blot.
        alpha = min(0.4, max(0.06, 25 / count))
        lines = LineCollection(part, color=look.colour, lw=0.4, alpha=alpha, rasterized=True)
        lines.set(capstyle="projecting", joinstyle="round")
        axis.add_collection(lines)
    axis.autoscale_view()
    # The vehicle that goes first drives faster, which leaves room below its traces. The one that
    # goes second leaves room above.
    y, va = (0.04, "bottom") if first == "left" else (0.96, "top")
    axis.text(0.98, y, f"n = {count}", transform=axis.transAxes, ha="right", va=va, fontsize=6)


def _draw_estimates(axis: Axes, group: Group, summary: Summary, styles: Styles) -> None:
    """Estimates of the relative velocities, side by side."""
    found = [points(group, velocity, summary) for velocity in styles]
    for index, (part, look) in enumerate(zip(found, styles.values(), strict=True)):
        draw_points(axis, part, 0.3 * (index - (len(styles) - 1) / 2), look)
    if group.measured:
        if not any(found):
            say(axis, "no such trial")
    elif summary is deviation:
        say(axis, MISSING)
    elif summary is gap:
        _draw_humans(axis, group, summary, styles, "--")


def _draw_humans(
    axis: Axes, human: Group, summary: Summary, styles: Styles, dashes: str = ":"
) -> None:
    """The humans as lines, of gaps before an import as the paper's regression has them."""
    for velocity in {*styles} & {*HUMAN_VELOCITIES_MPS}:
        if summary is gap and not human.measured:
            x, y = published_gap_line(velocity)
        else:
            found = points(human, velocity, summary)
            x = np.array([point.x for point in found], dtype=float)
            y = np.array([point.estimate.value for point in found], dtype=float)
        axis.plot(x, y, color=styles[velocity].colour, ls=dashes, lw=0.8)


def _scale(
    axes: NDArray[np.object_], groups: list[Group], study: Study, velocities: list[float]
) -> None:
    """One scale per quantity; a few very wide intervals must not flatten all the others."""
    speeds = [limit for axis in axes[0, :2] for limit in axis.get_ylim()]
    for axis in axes[0, :2]:
        axis.set_ylim(min(speeds), max(speeds))
    axes[0, 2].set_ylim(-0.08, 1.08)
    axes[0, 2].set_yticks([0, 0.5, 1])
    for axis, summary in zip(axes[0, 3:], SUMMARIES[1:], strict=True):
        found = [p.estimate for g in groups for v in velocities for p in points(g, v, summary)]
        as_published = summary is gap and not all(group.measured for group in groups)
        lines = [published_gap_line(v)[1] for v in HUMAN_VELOCITIES_MPS if as_published]
        if found:
            axis.set_ylim(*_limits(found, [float(y) for line in lines for y in line]))
    farthest_m = max(abs(headway_m) for headway_m, _ in study.conditions.values())
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


def _human_keys(study: Study) -> list[Line2D]:
    """How humans are shown beside drivers, and by what other than their own trials."""
    if study.human not in study.groups:
        return []
    keys = [Line2D([], [], color="#555555", ls=":", lw=0.8, label="humans")]
    if not study.human.measured:
        dashed = Line2D([], [], color="#555555", ls="--", lw=0.8, label="published regression")
        return [*keys, dashed]
    if study.human.traced:
        return keys
    return [*keys, Line2D([], [], ls="", label=f"humans in C: the {HUMAN_TRIALS} published")]
