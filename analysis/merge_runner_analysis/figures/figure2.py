"""Figure 2 of arXiv 2604.09609: a row per driver and prompt, a column per panel."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from numpy.typing import NDArray

from merge_runner.prompts.blocks import title_of
from merge_runner.scenarios.merge.conditions import HUMAN_CONDITIONS
from merge_runner_analysis.cache import remembered
from merge_runner_analysis.figures.style import (
    GREY,
    LINE_IN,
    PAGE_IN,
    Points,
    Style,
    choose_ticks,
    draw_points,
    place,
    style,
    wrapped,
)
from merge_runner_analysis.frames import KEYS
from merge_runner_analysis.grouping import Group
from merge_runner_analysis.published import HUMAN, published
from merge_runner_analysis.stats.estimate import Array, Estimate
from merge_runner_analysis.stats.intervals import mean, proportion
from merge_runner_analysis.stats.regressions import gap_design
from merge_runner_analysis.study import StudyResults

Styles = dict[float, Style]  # of relative velocities in m/s
LABEL = 21  # characters of a line of a row's name
# A row is so high, of few rows each higher; and what is above and below all rows.
ROW_IN, FEW_ROWS_IN, HIGHEST_ROW_IN, AROUND_IN = 0.62, 4.4, 1.1, 0.86
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
    "{left} first:\nv {left} (m/s)": "time (s)",
    "{left} second:\nv {left} (m/s)": "time (s)",
    "P({left}\nmerges first)": "headway (m)",
    "gap at\nmerge (m)": "headway (m)",
    "RMSE of\nspeed (m/s)": "headway (m)",
}
MISSING = "human recordings\nare not imported"
# The share of bounds of intervals that a scale shows: a few wide ones must not flatten the others.
SHOWN = 0.95
# A panel with more traces is an image, which takes 30 ms to make.
MANY_TRACES = 100


def figure2(study: StudyResults, chosen: list[Group]) -> Figure:
    """Return Figure 2: left speeds (A, B), who was first (C), gap (D), speed deviation (E)."""
    groups = [_played(study, group) for group in chosen]
    velocities = sorted({velocity for _, velocity in study.conditions.values()})
    styles = {velocity: style(number) for number, velocity in enumerate(velocities)}
    names = [
        "\n".join(wrapped(part, LABEL) for part in (group.label, title_of(group.setting)) if part)
        for group in groups
    ]
    rows = max(len(names), 1)
    lines = max((name.count("\n") + 1 for name in names), default=1)
    row_in = max(ROW_IN, min(HIGHEST_ROW_IN, FEW_ROWS_IN / rows), LINE_IN * lines + 0.2)
    figure = Figure(figsize=(PAGE_IN, AROUND_IN + rows * row_in), layout="constrained")
    axes = figure.subplots(rows, len(HEADINGS), sharex="col", sharey="col", squeeze=False)
    # Before anything is drawn, which would move all scales of a column each time.
    _scale(axes[0, 2:], groups, study)
    for row, group, name in zip(axes, groups, names, strict=False):
        row[0].set_ylabel(name, rotation=0, ha="right", va="center", multialignment="right")
        for axis, first in zip(row[:2], ("left", "right"), strict=True):
            _draw_traces(axis, study, group, first, styles)
        for axis, summary in zip(row[2:], COLUMNS, strict=True):
            _draw_estimates(axis, group, summary, styles)
            if group.setting and groups[0].driver == HUMAN:
                _draw_humans(axis, groups[0], summary, styles, ":")
    _scale_speeds(*axes[0, :2])
    # A group that is mirrored has its ego on the left.
    left = "ego" if any(group.measured and group.ego_sides[1] for group in groups) else "left"
    for axis, heading, panel in zip(axes[0], HEADINGS, "ABCDE", strict=True):
        axis.set_title(heading.format(left=left))
        axis.set_title(panel, loc="left", fontweight="bold")
    for axis, label in zip(axes[-1], HEADINGS.values(), strict=True):
        axis.set_xlabel(label)
    handles = []
    for velocity, look in styles.items():
        signed = f"{velocity:+g}".replace("-", "−") if velocity else "0"
        handles.append(Line2D([], [], label=f"Δv = {signed} m/s", **look))
    humans = {":": "humans", "--": "published regression"} if study.human in study.groups else {}
    handles += [
        Line2D([], [], color=GREY, ls=dashes, lw=0.8, label=label)
        for dashes, label in humans.items()
        if dashes == ":" or not study.human.measured
    ]
    figure.legend(
        handles=handles, loc="outside lower center", ncols=min(len(handles), 6), frameon=False
    )
    for panel in axes[0]:  # which all rows share
        choose_ticks(panel.xaxis, panel.yaxis)
    place(figure, axes)
    return figure


def left_first(merged_first: pd.Series) -> Estimate:
    """Return how often the left vehicle merges first (panel C)."""
    known = merged_first.dropna()
    return proportion(int((known == "left").sum()), len(known))


def gap(gaps_m: pd.Series) -> Estimate:
    """Return the mean gap in m (panel D)."""
    return mean(gaps_m.to_numpy(float))


def deviation(rmse_mps: pd.Series) -> Estimate:
    """Return the mean RMSE of both vehicles' speeds in m/s, never below 0 (panel E)."""
    rmse = mean(rmse_mps.to_numpy(float))
    return rmse if rmse.low is None else replace(rmse, low=max(0.0, rmse.low))


Summary = Callable[[pd.Series], Estimate]
COLUMNS: dict[Summary, str] = {left_first: "merged_first", gap: "gap_m", deviation: "rmse_mps"}


def points(group: Group, velocity_mps: float, summary: Summary) -> Points:
    """Return a summary by headway in m of the finished trials with this velocity."""
    return _points(group, summary).get(velocity_mps, [])


@remembered
def _points(group: Group, summary: Summary) -> dict[float, Points]:
    if summary is not left_first and not group.measured:
        return {}
    trials = group.outcomes if summary is left_first else group.trials
    columns = ["relative_velocity_mps", "projected_headway_m", "condition"]
    finished = trials.loc[trials["status"] == "finished", [*columns, COLUMNS[summary]]]
    by_velocity: dict[float, Points] = {}
    for (velocity, headway_m, _), values in finished.groupby(columns)[COLUMNS[summary]]:
        estimate = summary(values)
        if estimate.value is not None:
            by_velocity.setdefault(velocity, []).append((headway_m, estimate))
    return by_velocity


@remembered
def _played(study: StudyResults, group: Group) -> Group:
    """Return the group in the conditions of the study: humans drove in others, too."""
    return group.part(lambda trials: trials["condition"].isin(study.conditions))


@remembered
def left_traces(study: StudyResults, group: Group) -> dict[tuple[str, float], list[Array]]:
    """Return times in s and left speeds in m/s by who merged first and by velocity."""
    traces: dict[tuple[str, float], list[Array]] = {}
    if group.measured:
        speeds = study.read(EGO_SPEEDS)
        trials = group.finished[[*KEYS, "merged_first", "relative_velocity_mps"]]
        for row in speeds.merge(trials, on=KEYS).itertuples():
            key = (row.merged_first, row.relative_velocity_mps)
            traces.setdefault(key, []).append(np.column_stack([row.time_s, row.velocity_mps]))
    return traces


def published_gap_line(velocity_mps: float) -> tuple[Array, Array]:
    """Return the humans' regression of the gap as printed: headways and gaps in m."""
    farthest_m = max(abs(condition.projected_headway_m) for condition in HUMAN_CONDITIONS.values())
    headway = np.linspace(-farthest_m, farthest_m, 81)
    terms = published("paper_gap").query("driver == 'human'")["b"].to_numpy(float)
    return headway, gap_design(headway, np.full_like(headway, velocity_mps)) @ terms


def _draw_traces(axis: Axes, study: StudyResults, group: Group, first: str, styles: Styles) -> None:
    traces = left_traces(study, group)
    lines = [
        (line, look["color"])
        for velocity, look in styles.items()
        for line in traces.get((first, velocity), ())
    ]
    if not lines:
        _say(axis, "no such trial" if group.measured else MISSING)
        return
    # Many traces must not be one blot, nor a large file.
    count = len(lines)
    alpha, is_raster = min(0.4, max(0.06, 25 / count)), count > MANY_TRACES
    collection = LineCollection(
        [line for line, _ in lines],
        colors=[colour for _, colour in lines],
        lw=0.4,
        alpha=alpha,
        rasterized=is_raster,
    )
    collection.set(capstyle="projecting", joinstyle="round")
    axis.add_collection(collection)
    # The vehicle that goes first drives faster, which leaves room below its traces. The one that
    # goes second leaves room above.
    y, va = (0.04, "bottom") if first == "left" else (0.96, "top")
    axis.text(0.98, y, f"n = {count}", transform=axis.transAxes, ha="right", va=va, fontsize=6)


def _draw_estimates(axis: Axes, group: Group, summary: Summary, styles: Styles) -> None:
    series = [points(group, velocity, summary) for velocity in styles]
    for index, (part, look) in enumerate(zip(series, styles.values(), strict=True)):
        draw_points(axis, part, 0.3 * (index - (len(styles) - 1) / 2), look)
    if summary is gap and not group.measured:
        _draw_humans(axis, group, summary, styles, "--")
    elif not any(series):
        _say(axis, "no such trial" if group.measured else MISSING)


def _say(axis: Axes, text: str) -> None:
    place: Style = {"xycoords": "axes fraction", "ha": "center", "va": "top"}
    axis.annotate(text, (0.5, 0.9), fontsize=6, color=GREY, **place)


def _draw_humans(axis: Axes, human: Group, summary: Summary, styles: Styles, dashes: str) -> None:
    """Draw the humans as lines; before an import gaps follow the paper's regression."""
    for velocity in {*styles} & {*HUMAN_VELOCITIES_MPS}:
        if summary is gap and not human.measured:
            x, y = published_gap_line(velocity)
        else:
            means = [(x, estimate.value) for x, estimate in points(human, velocity, summary)]
            x, y = np.array(means, dtype=float).reshape(-1, 2).T
        axis.plot(x, y, color=styles[velocity]["color"], ls=dashes, lw=0.8)


def _scale_speeds(*panels: Axes) -> None:
    """Set one scale of speeds, that of all traces."""
    for axis in panels:
        axis.autoscale_view()
    speeds = [limit for axis in panels for limit in axis.get_ylim()]
    for axis in panels:
        axis.set_ylim(min(speeds), max(speeds))


def _scale(panels: NDArray[np.object_], groups: list[Group], study: StudyResults) -> None:
    """Set the scales of C to E: all values and lines, intervals as far as single trials reach."""
    panels[0].set(ylim=(-0.08, 1.08), yticks=[0, 0.5, 1])
    velocities = {velocity for _, velocity in study.conditions.values()}
    for axis, summary in zip(panels[1:], (gap, deviation), strict=True):
        estimates = [
            estimate for g in groups for v in velocities for _, estimate in points(g, v, summary)
        ]
        if not estimates:
            continue
        ends_of = [(estimate.value, estimate.low, estimate.high) for estimate in estimates]
        frame = pd.DataFrame(ends_of, dtype=float)
        single = pd.concat([g.finished[COLUMNS[summary]] for g in groups if g.measured])
        ends = frame[1].quantile(1 - SHOWN), frame[2].quantile(SHOWN)
        values = [*frame[0], max(ends[0], single.min()), min(ends[1], single.max())]
        if summary is gap and not all(group.measured for group in groups):
            values += [y for v in HUMAN_VELOCITIES_MPS for y in published_gap_line(v)[1]]
        low, high = np.nanmin(values), np.nanmax(values)
        margin = 0.08 * (high - low) or 1.0
        bottom = low - margin
        axis.set_ylim(bottom if summary is gap else max(0.0, bottom), high + margin)
    farthest_m = max(abs(headway_m) for headway_m, _ in study.conditions.values())
    for axis in panels:
        axis.set(xlim=(-farthest_m - 1, farthest_m + 1), xticks=[-farthest_m, 0, farthest_m])
