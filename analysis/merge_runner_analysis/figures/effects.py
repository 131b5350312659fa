"""Every level of every factor in each measure: dots and intervals, a mark for each driver."""

from __future__ import annotations

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from merge_runner.study.arms import MODEL
from merge_runner_analysis.figures.style import (
    GREY,
    LINE_IN,
    PAGE_IN,
    choose_ticks,
    draw_points,
    place,
    style,
    wrapped,
)
from merge_runner_analysis.grouping import levels_of
from merge_runner_analysis.metrics import LEFT_FIRST
from merge_runner_analysis.stats.effects import measured
from merge_runner_analysis.stats.levels import Level, levels_by_factor
from merge_runner_analysis.stats.sides import level_estimate
from merge_runner_analysis.study import StudyResults

ACROSS = 3  # panels
LABEL, LEGEND = 24, 48  # characters of a line
LINES_IN = 2.2 * LINE_IN  # from one level to the next
MARK = 0.03  # of an axis: the width of a mark
EVEN = 50.0  # percent: neither driver is favoured


def effects_figure(study: StudyResults) -> Figure:
    """Return the figure: a panel per measure, a line per level, a mark per driver."""
    lines = _lines(study)
    every = [level for levels in lines.values() for _, level in levels]
    metrics = [
        metric
        for metric in measured(study)
        if metric.estimator != "median"
        and any(level_estimate(study, level, metric).value is not None for level in every)
    ]
    drivers = list(dict.fromkeys(driver for levels in lines.values() for driver, _ in levels))
    looks = {driver: style(number) for number, driver in enumerate(drivers)}
    across, down = min(ACROSS, len(metrics)) or 1, -(-len(metrics) // ACROSS) or 1
    height_in = down * (LINES_IN * len(lines) + 0.6) + LINE_IN * 2 * len(drivers)
    figure = Figure(figsize=(PAGE_IN, max(height_in, 1.5)), layout="constrained")
    axes = figure.subplots(down, across, sharey=True, squeeze=False).flatten()
    for axis, metric in zip(axes, metrics, strict=False):
        axis.set_xlabel(metric.heading)
        for number, (driver, look) in enumerate(looks.items()):
            points = [
                (float(place), level_estimate(study, level, metric))
                for place, levels in enumerate(lines.values())
                for name, level in levels
                if name == driver
            ]
            shift = 0.5 * (number + 0.5) / len(drivers) - 0.25
            draw_points(axis, points, shift, look | {"ls": ""}, horizontal=True)
        if metric is LEFT_FIRST:
            axis.axvline(EVEN, color=GREY, ls=":", lw=0.8)
        _limit(axis, 0.0 if metric.rate else metric.least, 100.0 if metric.unit == "%" else None)
    for axis in axes[max(1, len(metrics)) :]:
        axis.set_visible(False)
    axes[0].set_yticks(range(len(lines)), [wrapped(name, LABEL) for name in lines])
    axes[0].set_ylim(max(len(lines), 1) - 0.5, -0.5)
    if not lines:
        axes[0].set_xlabel("the drivers differ in no factor")
    handles = [
        Line2D([], [], label=wrapped(driver, LEGEND), **look | {"ls": ""})
        for driver, look in looks.items()
    ]
    if handles:
        figure.legend(handles=handles, loc="outside lower center", ncols=2, frameon=False)
    choose_ticks(*(axis.xaxis for axis in axes))
    place(figure)
    return figure


def _lines(study: StudyResults) -> dict[str, list[tuple[str, Level]]]:
    """Return by line its levels, each with its driver; without a factor one line of all drivers."""
    factors = levels_of(study.models, study.order)
    lines: dict[str, list[tuple[str, Level]]] = {
        f"{factor}: {name}": []
        for factor, names in factors.items()
        for name in names
        if factor != MODEL and len(names) > 1
    }
    # In the order of other figures, so that a driver has one colour.
    for model in dict.fromkeys(group.levels.get(MODEL, "") for group in study.models):
        for levels in levels_by_factor(study, MODEL, model, 1):
            for level in levels:
                line = f"{level.factor}: {level.name}"
                if line in lines:
                    lines[line].append((_named(model, level), level))
    if not lines:
        drivers = [level for levels in levels_by_factor(study) for level in levels]
        lines = {"all trials": [(_named(level.name, level), level) for level in drivers]}
    return {line: levels for line, levels in lines.items() if levels}


def _named(driver: str, level: Level) -> str:
    return f"{driver} ({level.posing})" if level.posing else driver


def _limit(axis: Axes, least: float | None, most: float | None) -> None:
    """Let the axis end where values do, but for the width of a mark."""
    low, high = axis.get_xlim()
    mark = MARK * (high - low)
    axis.set_xlim(
        low if least is None else max(low, least - mark),
        high if most is None else min(high, most + mark),
    )
