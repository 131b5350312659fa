"""Means of first actions by own relative velocity, of every driver's baseline prompt."""

from __future__ import annotations

from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from merge_runner.prompts.blocks import BASELINE
from merge_runner_analysis.figures.style import (
    LINE_IN,
    LINES,
    PAGE_IN,
    Points,
    draw_points,
    place,
    style,
    wrapped,
)
from merge_runner_analysis.published import published
from merge_runner_analysis.stats.estimate import Estimate
from merge_runner_analysis.stats.first_action import GroupDriver, drivers_of, first_actions, mean
from merge_runner_analysis.stats.intervals import interval
from merge_runner_analysis.study import StudyResults

LEGEND = 48  # characters of a line


def first_action(study: StudyResults) -> Figure:
    """Return the figure."""
    groups = [g for g in (*study.baselines, *study.probes) if g.setting == BASELINE]
    drawn = [(LINES | {"color": "black", "marker": "o"}, "humans", _human_first_actions(study))]
    for number, driver in enumerate(driver for group in groups for driver in drivers_of(group)):
        drawn.append((style(number), driver.name, _first_actions(study, driver)))
    labels = [wrapped(name, LEGEND) for _, name, _ in drawn]
    legend_in = LINE_IN * sum(label.count("\n") + 1.5 for label in labels)
    figure = Figure(figsize=(PAGE_IN, max(2.7, legend_in)), layout="constrained")
    axis = figure.subplots()
    # Beside each other, and far from the next velocity.
    apart_mps = min(0.04, 0.4 / len(drawn))
    for number, (look, _, means) in enumerate(drawn):
        draw_points(axis, means, apart_mps * number, look)
    axis.set(xlabel="own relative velocity (m/s)", ylabel="first action (m/s²)")
    handles = [
        Line2D([], [], label=label, **look)
        for label, (look, _, _) in zip(labels, drawn, strict=True)
    ]
    figure.legend(handles=handles, loc="outside right center", frameon=False)
    place(figure)
    return figure


def _human_first_actions(study: StudyResults) -> Points:
    if study.complete:
        return _first_actions(study, GroupDriver(study.human))
    return [
        (row.relative_velocity_mps, Estimate(mps2, *interval(mps2, row.se_mps2), row.n))
        for row in published("human_first_actions").itertuples()
        for mps2 in (row.mean_mps2,)
    ]


def _first_actions(study: StudyResults, driver: GroupDriver) -> Points:
    by_velocity = first_actions(study, driver).groupby("velocity_mps")
    estimates = ((float(velocity), mean(rows)) for velocity, rows in by_velocity)
    return [(velocity, estimate) for velocity, estimate in estimates if estimate]
