"""What each level of a study's factors comes to, a panel per metric."""

from __future__ import annotations

from math import ceil

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from merge_runner_analysis.data.study import Study
from merge_runner_analysis.figures.drawing import PAGE_IN, line_count, say, wrapped
from merge_runner_analysis.figures.styles import driver_style
from merge_runner_analysis.metrics import METRICS, Metric
from merge_runner_analysis.stats.factors import Level, levels_by_factor
from merge_runner_analysis.stats.measures import estimate

PANELS = 4
NAME_IN, ROW_IN, AXIS_IN = 1.1, 0.2, 0.55


def figure_of_factors(study: Study) -> Figure:
    """Each level's estimate with its interval; the levels of a factor stand together."""
    found = levels_by_factor(study)
    if not found:
        figure = Figure(figsize=(PAGE_IN, 1.0))
        say(figure.subplots(), "the trials of drivers differ in no factor")
        return figure
    rows = [(number, level) for number, levels in enumerate(found) for level in levels]
    places = [place + 0.5 * number for place, (number, _) in enumerate(rows)]
    names = [wrapped(_name(level), NAME_IN) for _, level in rows]
    bands = ceil(len(METRICS) / PANELS)
    row_in = max(ROW_IN, 0.12 * line_count(names) + 0.04)
    height_in = bands * (AXIS_IN + row_in * (places[-1] + 1))
    figure = Figure(figsize=(PAGE_IN, height_in), layout="constrained")
    axes = figure.subplots(bands, PANELS, sharey=True, squeeze=False)
    for axis, metric in zip(axes.flat, METRICS.values(), strict=False):
        for (number, level), place in zip(rows, places, strict=True):
            _estimate(axis, level, metric, place, driver_style(number).colour)
        axis.set_xlabel(metric.heading)
    for axis in axes.flat[len(METRICS) :]:
        axis.set_visible(False)
    axes[0, 0].set_yticks(places, names)
    axes[0, 0].set_ylim(places[-1] + 0.6, -0.6)
    return figure


def _name(level: Level) -> str:
    """``temperature=0.2``, with stand-ins marked as such."""
    return f"{level.factor}={level.name}" + (f" ({level.posing})" if level.posing else "")


def _estimate(axis: Axes, level: Level, metric: Metric, place: float, colour: str) -> None:
    found = estimate(level.pooled, metric)
    if found.value is None:
        axis.annotate("no trial has it", (0.02, place), xycoords=("axes fraction", "data"))
        return
    low, high = found.bounds() or (found.value, found.value)
    axis.errorbar(
        found.value, place, xerr=[[found.value - low], [high - found.value]], color=colour,
        marker="o", ms=3, elinewidth=0.8, capsize=1.5, mfc="white", mew=0.8,
    )  # fmt: skip
