"""The figures: Figure 2 of arXiv 2604.09609, the ablation matrix, and distributions."""

from __future__ import annotations

import io
from collections.abc import Callable, Iterator
from functools import cache
from math import ceil
from pathlib import Path
from typing import Any, Literal

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure, SubFigure
from numpy.typing import NDArray

from merge_runner.errors import UsageError
from merge_runner_analysis.data.study import Group, Study
from merge_runner_analysis.figures.drawing import (
    COLUMN_IN,
    LINE_IN,
    MISSING,
    PAGE_IN,
    draw_points,
    draw_traces,
    key,
    letter,
    line_count,
    named,
    remarks,
    say,
    velocity_text,
    wrapped,
)
from merge_runner_analysis.figures.factor_figure import figure_of_factors
from merge_runner_analysis.figures.first_action_figure import figure_of_first_actions
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
from merge_runner_analysis.figures.styles import HUMAN_STYLE, ORANGE, SKY_BLUE, Style, driver_style
from merge_runner_analysis.figures.variant_figure import figure_2_variants
from merge_runner_analysis.metrics import Metric, shown_in
from merge_runner_analysis.stats.group_scores import score
from merge_runner_analysis.stats.indicators import INDICATORS
from merge_runner_analysis.stats.measures import human_reference, known, values

LEGEND_COLUMNS = 4
PASSED, FAILED, UNKNOWN = SKY_BLUE, ORANGE, "#dddddd"
# These settings are fixed, so that equal input gives equal files.
SETTINGS: Any = {
    "font.size": 7,
    "axes.titlesize": 7,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.linewidth": 0.6,
    "pdf.fonttype": 42,
    "text.parse_math": False,  # a dollar sign in a name does not start a formula
    "svg.hashsalt": "merge-runner",
    "savefig.dpi": 300,
}


def figure_2(study: Study) -> Figure:
    """Velocities of the left vehicle (A, B), who was first (C), gap (D), speed deviation (E)."""
    groups = drawn_groups(study, study.baselines)
    figure = Figure(figsize=(PAGE_IN, 8.2), layout="constrained")
    parts: Any = figure.subfigures(2, 1, height_ratios=(2, 3))
    traces, curves = parts
    frames = traces.subplots(2, max(len(groups), 1), sharex=True, sharey=True, squeeze=False)
    _traces(frames, study, groups)
    velocities = velocities_mps(study)
    axes = curves.subplots(3, len(velocities), sharex=True, sharey="row", squeeze=False)
    _curves(axes[0], groups, left_first, velocities, "C", "P(left merges first)")
    _curves(axes[1], groups, gaps, velocities, "D", "gap at merge (m)")
    _curves(axes[2], groups, deviations, velocities, "E", "RMSE of speed (m/s)")
    axes[0, 0].set_ylim(-0.05, 1.05)
    unmeasured = not all(group.measured for group in groups)
    for column, velocity in enumerate(velocities):
        axes[0, column].set_title(f"Δv = {velocity_text(velocity)}")
        axes[2, column].set_xlabel("projected headway (m)")
        axes[2, column].set_xticks(np.linspace(-1, 1, 5) * farthest_headway_m(study))
        if unmeasured and velocity in HUMAN_VELOCITIES_MPS:
            axes[1, column].plot(*published_gap_line(velocity), color="black", ls="--", lw=0.8)
            axes[2, column].margins(y=0.3)
            say(axes[2, column], MISSING, 0.99)
    _legend(curves, study, groups)
    return figure


def ablation_matrix(study: Study) -> Figure:
    """Which indicators hold for which driver and variant; text and colour say the same."""
    groups = study.groups
    names = [wrapped(named(group), COLUMN_IN / 2) for group in groups]
    row_in = max(0.22, LINE_IN * line_count(names) + 0.04)
    figure = Figure(figsize=(COLUMN_IN, 0.6 + row_in * len(groups)), layout="constrained")
    axes = figure.subplots()
    for row, group in enumerate(groups):
        found = score(study, group)
        for column, name in enumerate(INDICATORS):
            passed, robust = found.paper[name].passed, found.robust[name].passed
            colour = UNKNOWN if passed is None else PASSED if passed else FAILED
            axes.add_patch(
                mpl.patches.Rectangle((column, row), 1, 1, facecolor=colour, edgecolor="white")
            )
            text = _mark(passed)
            if robust is not None and robust != passed:
                text += f" / {_mark(robust)}"
            axes.text(column + 0.5, row + 0.5, text, ha="center", va="center", fontsize=6)
    axes.set(xlim=(0, len(INDICATORS)), ylim=(len(groups), 0))
    axes.set_xticks(np.arange(len(INDICATORS)) + 0.5, list(INDICATORS))
    axes.set_yticks(np.arange(len(groups)) + 0.5, names)
    axes.tick_params(length=0, labeltop=True, labelbottom=False)
    axes.spines[:].set_visible(False)
    return figure


def distributions(study: Study) -> Figure:
    """Each metric other than rates, for every group: median, quartiles, and every trial."""
    groups, metrics = study.groups, _distributed()
    names = [wrapped(named(group), PAGE_IN / 4) for group in groups]
    row_in = max(0.28, LINE_IN * line_count(names) + 0.04)
    lines = ceil(len(metrics) / 2)
    size = (PAGE_IN, lines * (0.8 + row_in * len(groups)))
    figure = Figure(figsize=size, layout="constrained")
    axes = figure.subplots(lines, 2, sharey=True, squeeze=False)
    for axis, metric in zip(axes.flat, metrics, strict=False):
        for row, group in enumerate(groups):
            _distribution(axis, row, group, metric, _style(study.baselines, group).colour)
        axis.set_xlabel(metric.heading)
    for axis in axes.flat[len(metrics) :]:
        axis.set_visible(False)
    axes[0, 0].set_yticks(range(len(groups)), names)
    axes[0, 0].set_ylim(len(groups) - 0.5, -0.5)
    return figure


def _distributed() -> list[Metric]:
    """The metrics whose values have a distribution to show; a rate's values are only 0 and 1."""
    return shown_in("distributions")


def _distribution(axis: Axes, row: int, group: Group, metric: Metric, colour: str) -> None:
    if not known(group, metric):
        _reference(axis, row, metric, colour)
        return
    found = values(group, metric).to_numpy(float)
    if not len(found):
        there = group.ended if metric.trials == "ended" else group.finished
        text = "no trial has it" if len(there) else f"no {metric.trials} trial"
        axis.annotate(text, (0.02, row), xycoords=("axes fraction", "data"))
        return
    # Spread by rank, not by chance: the same trials give the same picture.
    spread = row + 0.36 * (np.arange(len(found)) % 7 / 6 - 0.5)
    axis.plot(found, spread, ".", color=colour, ms=1.5, alpha=0.4, rasterized=True)
    axis.boxplot(
        found, positions=[row], orientation="horizontal", widths=0.6, showfliers=False,
        medianprops={"color": colour, "lw": 1.4}, manage_ticks=False,
    )  # fmt: skip


def _reference(axis: Axes, row: int, metric: Metric, colour: str) -> None:
    """The published value of humans without traces, or a remark that there is none."""
    found = human_reference(metric)
    if found is None:
        axis.annotate("no published value", (0.02, row), xycoords=("axes fraction", "data"))
        return
    axis.plot(found.value, row, "D", color=colour, ms=4)
    text = f"published {metric.estimator}"
    axis.annotate(text, (found.value, row), (6, -2), textcoords="offset points", fontsize=6)


METADATA: dict[str, dict[str, None]] = {
    "pdf": {"CreationDate": None, "Creator": None, "Producer": None},
    "png": {"Software": None},
    "svg": {"Date": None, "Creator": None},
}
MAKERS: dict[str, Callable[[Study], Figure]] = {
    "figure2": figure_2,
    "figure2-variants": figure_2_variants,
    "ablation-matrix": ablation_matrix,
    "distributions": distributions,
    "factors": figure_of_factors,
    "first-action": figure_of_first_actions,
}


def write_figures(study: Study, folder: Path) -> Iterator[Path]:
    """Write every figure as PDF and PNG; yields the paths. Raises UsageError."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as exc:
        raise UsageError(f"{folder} cannot be made: {exc}") from exc
    for name in MAKERS:
        for form in ("pdf", "png"):
            path = folder / f"{name}.{form}"
            path.write_bytes(rendered(study, name, form))
            yield path


def rendered(study: Study, name: str, form: Literal["pdf", "png", "svg"]) -> bytes:
    """One figure as a file, without a date, so that equal results give equal bytes."""
    out = io.BytesIO()
    with mpl.rc_context(SETTINGS):
        _figure(study, name).savefig(out, format=form, metadata=METADATA[form])
    return out.getvalue()


@cache
def _figure(study: Study, name: str) -> Figure:
    """A figure, laid out once for all its forms."""
    figure = MAKERS[name](study)
    engine = figure.get_layout_engine()
    if engine is not None:
        engine.execute(figure)
        figure.set_layout_engine(None)  # or the figure would be laid out again for every form
    return figure


def _traces(axes: NDArray[np.object_], study: Study, groups: list[Group]) -> None:
    for column, group in enumerate(groups):
        for row, (first, panel) in enumerate((("left", "A"), ("right", "B"))):
            axis: Axes = axes[row, column]
            found = left_traces(study, group, first)
            colour = _style(groups, group).colour
            draw_traces(axis, found, colour, len(found))
            if not group.measured:
                say(axis, MISSING)
            elif not found:
                say(axis, f"{first} never merged first")
            if row == 0:
                axis.set_title(wrapped(group.label, 0.85 * PAGE_IN / len(groups)))
            if found:
                axis.text(0.98, 0.04, f"n = {len(found)}", transform=axis.transAxes, ha="right")
            if column == 0:
                place = "first" if first == "left" else "second"
                axis.set_ylabel(f"left merges {place}\nv left (m/s)")
                letter(axis, panel, 1.06)
            if row == 1:
                axis.set_xlabel("time (s)")


def _curves(
    axes: NDArray[np.object_],
    groups: list[Group],
    points: Callable[[Group, float], list[Point]],
    velocities: list[float],
    panel: str,
    label: str,
) -> None:
    axes[0].set_ylabel(label)
    letter(axes[0], panel, 1.06)
    for axis, velocity in zip(axes, velocities, strict=True):
        for index, group in enumerate(groups):
            found = points(group, velocity)
            # Side by side, so that intervals do not hide each other.
            shift = 0.16 * (index - (len(groups) - 1) / 2)
            draw_points(axis, found, shift, _style(groups, group))


def _legend(figure: SubFigure, study: Study, groups: list[Group]) -> None:
    handles = []
    for group in groups:
        label = wrapped(group.label, PAGE_IN / LEGEND_COLUMNS - 0.4)
        handles.append(key(_style(groups, group), label))
    handles += remarks(study, "black")
    figure.legend(handles=handles, loc="outside lower center", ncols=LEGEND_COLUMNS, frameon=False)


def _style(groups: list[Group], group: Group) -> Style:
    """The style of a driver, the same for all its variants."""
    if not group.setting:
        return HUMAN_STYLE
    drivers = list(dict.fromkeys(g.driver for g in groups if g.setting))
    index = drivers.index(group.driver) if group.driver in drivers else len(drivers)
    return driver_style(index)


def _mark(passed: bool | None) -> str:
    return "–" if passed is None else "✓" if passed else "✗"
