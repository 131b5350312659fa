"""Figure 2 of arXiv 2604.09609: a row per driver and prompt, a column per panel."""

from __future__ import annotations

import re
import textwrap
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from numpy.typing import NDArray

from merge_runner.prompts.blocks import title_of
from merge_runner.scenarios.merge.conditions import HUMAN_CONDITIONS
from merge_runner_analysis.grouping import Group, of_trials
from merge_runner_analysis.published import HUMAN, published
from merge_runner_analysis.stats.estimate import Estimate
from merge_runner_analysis.stats.intervals import mean, proportion
from merge_runner_analysis.stats.regressions import gap_design
from merge_runner_analysis.study import Study

# IEEE transactions: one column and the whole page, in inches.
COLUMN_IN, PAGE_IN = 3.5, 7.16
# A character of the figures' font, as wide as the wider ones are.
CHARACTER_IN = 0.06
BREAK = "\u200b"  # a zero-width space
# The palette of Okabe and Ito (2008), safe for the colour-blind.
COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#56b4e9", "#e69f00")
MARKERS = "v^sDPX"
Points = list[tuple[float, Estimate]]  # estimates at their places on an axis
Array = NDArray[np.float64]
# Laid out by hand, in inches: many rows of equal panels need no solver.
LABEL_IN, ROW_IN, LINE_IN = 1.15, 0.62, 0.12
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
HEADINGS = {
    "left first:\nv left (m/s)": "time (s)",
    "left second:\nv left (m/s)": "time (s)",
    "P(left\nmerges first)": "headway (m)",
    "gap at\nmerge (m)": "headway (m)",
    "RMSE of\nspeed (m/s)": "headway (m)",
}
MISSING = "human recordings\nare not imported"
# The share of bounds of intervals that a scale shows: a few wide ones must not flatten the others.
SHOWN = 0.95


class Style(NamedTuple):
    """A colour, and a marker as matplotlib names it."""

    colour: str
    marker: str


Styles = dict[float, Style]  # of relative velocities in m/s


def style(number: int) -> Style:
    """A style, counted from 0; once the colours are used up, each comes with another marker."""
    turn = number + number // len(COLOURS)
    return Style(COLOURS[number % len(COLOURS)], MARKERS[turn % len(MARKERS)])


def wrapped(text: str, width_in: float) -> str:
    """A name in lines no wider than this, broken at blanks or punctuation, or else anywhere."""
    marked = re.sub(r"([+/])", f"\\1{BREAK} ", text)
    lines = textwrap.wrap(marked, max(6, int(width_in / CHARACTER_IN)))
    return "\n".join(re.sub(f"{BREAK} ?", "", line) for line in lines)


def key(style: Style, label: str) -> Line2D:
    """A line of a legend."""
    return Line2D(
        [], [], color=style.colour, marker=style.marker, ms=3, lw=0.8, mfc="white", label=label
    )


def draw_points(axis: Axes, points: Points, shift: float, style: Style) -> None:
    """Draw estimates with their intervals, ``shift`` beside their places on the axis."""
    rows = [(x + shift, one.value, one.low, one.high) for x, one in points]
    x, y, low, high = np.array(rows, dtype=float).reshape(-1, 4).T
    axis.errorbar(
        x, y, yerr=np.nan_to_num(np.vstack([y - low, high - y])), color=style.colour,
        marker=style.marker, ms=3, lw=0.8, elinewidth=0.7, capsize=1.5, mfc="white", mew=0.8,
    )  # fmt: skip


def figure_2(study: Study, chosen: list[Group]) -> Figure:
    """Left speeds (A, B), who was first (C), gap (D) and speed deviation (E) of these groups."""
    # Humans drove in conditions, too, that no driver of this study did.
    groups = [
        group.part(lambda trials: trials["condition"].isin(study.conditions)) for group in chosen
    ]
    velocities = sorted({velocity for _, velocity in study.conditions.values()})
    styles = {velocity: style(number) for number, velocity in enumerate(velocities)}
    parts = [(group.label, title_of(group.setting)) for group in groups]
    names = ["\n".join(wrapped(part, LABEL_IN) for part in pair).strip() for pair in parts]
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
                _draw_humans(axis, groups[0], summary, styles, ":")
    _scale(axes, groups, study)
    for axis, heading, panel in zip(axes[0], HEADINGS, "ABCDE", strict=True):
        axis.set_title(heading)
        axis.text(-0.02, 1.1, panel, transform=axis.transAxes, fontweight="bold", ha="right")
    for axis, label in zip(axes[-1], HEADINGS.values(), strict=True):
        axis.set_xlabel(label)
    signed = (f"{v:+g}".replace("-", "−") if v else "0" for v in velocities)
    handles = [key(styles[v], f"Δv = {text} m/s") for v, text in zip(styles, signed, strict=True)]
    lines = {":": "humans", "--": "published regression"} if study.human in study.groups else {}
    handles += [
        Line2D([], [], color="#555555", ls=dashes, lw=0.8, label=label)
        for dashes, label in lines.items()
        if dashes == ":" or not study.human.measured
    ]
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
    """Panel E: mean RMSE of the speed in m/s, of a trial that of both vehicles."""
    return mean(trials["rmse_mps"].to_numpy(float))


Summary = Callable[[pd.DataFrame], Estimate]
SUMMARIES: tuple[Summary, ...] = (left_first, gap, deviation)


def points(group: Group, velocity_mps: float, summary: Summary) -> Points:
    """A summary of the finished trials of each condition with this velocity, by headway in m."""
    if summary is not left_first and not group.measured:
        return []
    trials = group.outcomes if summary is left_first else group.trials
    chosen = trials[
        (trials["status"] == "finished") & (trials["relative_velocity_mps"] == velocity_mps)
    ]
    conditions = chosen.groupby(["projected_headway_m", "condition"])
    found = [(headway_m, summary(rows)) for (headway_m, _), rows in conditions]
    return [(x, estimate) for x, estimate in found if estimate.value is not None]


def left_traces(study: Study, group: Group, first: str) -> dict[float, list[Array]]:
    """Panels A and B: times in s and left speeds in m/s, (n, 2), where ``first`` merged first.

    By relative velocity. Of two different drivers the left one is the ego, as everywhere here.
    """
    if not group.measured:
        return {}
    found: dict[float, list[Array]] = {}
    for velocity, trials in group.finished.groupby("relative_velocity_mps"):
        rows = of_trials(study.read(EGO_SPEEDS), trials[trials["merged_first"] == first])
        traces = zip(rows["time_s"], rows["velocity_mps"], strict=True)
        found[float(velocity)] = [np.column_stack(trace) for trace in traces]
    return found


def published_gap_line(velocity_mps: float) -> tuple[Array, Array]:
    """The human regression of the gap as the paper prints it: headways and gaps in m.

    The line spans the headways of the humans' conditions, whatever other conditions were driven.
    """
    farthest_m = max(abs(one.projected_headway_m) for one in HUMAN_CONDITIONS.values())
    headway = np.linspace(-farthest_m, farthest_m, 81)
    terms = published("paper_gap").query("driver == 'human'")["b"].to_numpy(float)
    return headway, gap_design(headway, np.full_like(headway, velocity_mps)) @ terms


def _panels(names: list[str]) -> tuple[Figure, NDArray[np.object_]]:
    """A figure of page width with a row of panels of equal size for each name."""
    rows = max(len(names), 1)
    lines = max((name.count("\n") + 1 for name in names), default=1)
    row_in = max(ROW_IN, min(HIGHEST_ROW_IN, FEW_ROWS_IN / rows), LINE_IN * lines + 0.05)
    height_in = TOP_IN + BOTTOM_IN + rows * row_in - BETWEEN_ROWS_IN
    panel_in = (PAGE_IN - LEFT_IN - RIGHT_IN + BETWEEN_COLUMNS_IN) / len(HEADINGS)
    figure = Figure(figsize=(PAGE_IN, height_in))
    figure.subplots_adjust(
        left=LEFT_IN / PAGE_IN,
        right=1 - RIGHT_IN / PAGE_IN,
        top=1 - TOP_IN / height_in,
        bottom=BOTTOM_IN / height_in,
        hspace=BETWEEN_ROWS_IN / (row_in - BETWEEN_ROWS_IN),
        wspace=BETWEEN_COLUMNS_IN / (panel_in - BETWEEN_COLUMNS_IN),
    )
    return figure, figure.subplots(rows, len(HEADINGS), sharex="col", sharey="col", squeeze=False)


def _draw_traces(axis: Axes, study: Study, group: Group, first: str, styles: Styles) -> None:
    """The left speeds of those trials in which this side merged first."""
    traces = left_traces(study, group, first)
    count = sum(len(traces.get(velocity, ())) for velocity in styles)
    if not count:
        _say(axis, "no such trial" if group.measured else MISSING)
        return
    for velocity, look in styles.items():
        # Many traces must not be one blot.
        alpha = min(0.4, max(0.06, 25 / count))
        lines = LineCollection(
            traces.get(velocity, []), color=look.colour, lw=0.4, alpha=alpha, rasterized=True
        )
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
    if summary is gap and not group.measured:
        _draw_humans(axis, group, summary, styles, "--")
    elif not any(found):
        _say(axis, "no such trial" if group.measured else MISSING)


def _say(axis: Axes, text: str) -> None:
    """A remark in a panel."""
    axis.text(
        0.5, 0.9, text, transform=axis.transAxes, ha="center", va="top", fontsize=6,
        color="#555555",
    )  # fmt: skip


def _draw_humans(axis: Axes, human: Group, summary: Summary, styles: Styles, dashes: str) -> None:
    """The humans as lines, of gaps before an import as the paper's regression has them."""
    for velocity in {*styles} & {*HUMAN_VELOCITIES_MPS}:
        if summary is gap and not human.measured:
            x, y = published_gap_line(velocity)
        else:
            found = [(x, one.value) for x, one in points(human, velocity, summary)]
            x, y = np.array(found, dtype=float).reshape(-1, 2).T
        axis.plot(x, y, color=styles[velocity].colour, ls=dashes, lw=0.8)


def _scale(axes: NDArray[np.object_], groups: list[Group], study: Study) -> None:
    """One scale per quantity, which shows all values and lines, and most intervals."""
    speeds = [limit for axis in axes[0, :2] for limit in axis.get_ylim()]
    for axis in axes[0, :2]:
        axis.set_ylim(min(speeds), max(speeds))
    axes[0, 2].set(ylim=(-0.08, 1.08), yticks=[0, 0.5, 1])
    velocities = {velocity for _, velocity in study.conditions.values()}
    for axis, summary in zip(axes[0, 3:], SUMMARIES[1:], strict=True):
        found = [one for g in groups for v in velocities for _, one in points(g, v, summary)]
        if not found:
            continue
        frame = pd.DataFrame([(one.value, one.low, one.high) for one in found], dtype=float)
        values = [*frame[0], frame[1].quantile(1 - SHOWN), frame[2].quantile(SHOWN)]
        if summary is gap and not all(group.measured for group in groups):
            values += [y for v in HUMAN_VELOCITIES_MPS for y in published_gap_line(v)[1]]
        low, high = np.nanmin(values), np.nanmax(values)
        margin = 0.08 * (high - low) or 1.0
        axis.set_ylim(low - margin, high + margin)
    farthest_m = max(abs(headway_m) for headway_m, _ in study.conditions.values())
    for axis in axes[0, 2:]:
        axis.set(xlim=(-farthest_m - 1, farthest_m + 1), xticks=[-farthest_m, 0, farthest_m])
