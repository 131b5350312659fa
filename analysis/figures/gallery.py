"""The figures, and how they are written: equal results give equal files."""

from __future__ import annotations

import io
from collections.abc import Callable, Iterator, Sequence
from functools import cache
from math import ceil
from pathlib import Path
from typing import Any, Literal

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from merge_runner.errors import UsageError
from merge_runner_analysis.data.reference_data import published
from merge_runner_analysis.data.study import Group, Study
from merge_runner_analysis.figures.drawing import (
    BLUE,
    COLUMN_IN,
    HUMAN_STYLE,
    ORANGE,
    PAGE_IN,
    SKY_BLUE,
    Point,
    draw_points,
    key,
    named,
    row_height_in,
    say,
    style,
    wrapped,
)
from merge_runner_analysis.figures.figure_2 import figure_2
from merge_runner_analysis.metrics import METRICS, Metric, shown_in
from merge_runner_analysis.names import BASELINE
from merge_runner_analysis.stats.factors import Level, levels_by_factor
from merge_runner_analysis.stats.first_action import Seat, first_actions, mean, seats
from merge_runner_analysis.stats.indicators import INDICATORS, score
from merge_runner_analysis.stats.intervals import Estimate, interval
from merge_runner_analysis.stats.measures import estimate, human_reference, known, values

PASSED, FAILED, UNKNOWN = SKY_BLUE, ORANGE, "#dddddd"
MARKS = {None: "–", True: "✓", False: "✗"}
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
METADATA: dict[str, dict[str, None]] = {
    "pdf": {"CreationDate": None, "Creator": None, "Producer": None},
    "png": {"Software": None},
    "svg": {"Date": None, "Creator": None},
}


def ablation_matrix(study: Study) -> Figure:
    """Which indicators hold for which driver and prompt; text and colour say the same."""
    groups = study.groups
    names = [wrapped(named(group), COLUMN_IN / 2) for group in groups]
    height_in = 0.6 + row_height_in(names, 0.22) * len(groups)
    figure = Figure(figsize=(COLUMN_IN, height_in), layout="constrained")
    axes = figure.subplots()
    for row, group in enumerate(groups):
        found = score(study, group)
        for column, name in enumerate(INDICATORS):
            passed, robust = found.paper[name].passed, found.robust[name].passed
            colour = UNKNOWN if passed is None else PASSED if passed else FAILED
            axes.add_patch(
                mpl.patches.Rectangle((column, row), 1, 1, facecolor=colour, edgecolor="white")
            )
            differs = robust is not None and robust != passed
            text = f"{MARKS[passed]} / {MARKS[robust]}" if differs else MARKS[passed]
            axes.text(column + 0.5, row + 0.5, text, ha="center", va="center", fontsize=6)
    axes.set(xlim=(0, len(INDICATORS)), ylim=(len(groups), 0))
    axes.set_xticks(np.arange(len(INDICATORS)) + 0.5, list(INDICATORS))
    axes.set_yticks(np.arange(len(groups)) + 0.5, names)
    axes.tick_params(length=0, labeltop=True, labelbottom=False)
    axes.spines[:].set_visible(False)
    return figure


def distributions(study: Study) -> Figure:
    """Each metric but rates, whose values are only 0 and 1: quartiles, and every trial."""
    metrics = [metric for metric in shown_in("distributions") if not metric.rate]
    names = [wrapped(named(group), PAGE_IN / 4) for group in study.groups]

    def draw(axis: Axes, row: int, metric: Metric) -> None:
        _distribution(axis, row, study.groups[row], metric)

    return _panels(metrics, names, range(len(names)), 2, draw)


def figure_of_factors(study: Study) -> Figure:
    """Each level's estimate with its interval; the levels of a factor stand together."""
    found = levels_by_factor(study)
    if not found:
        figure = Figure(figsize=(PAGE_IN, 1.0))
        say(figure.subplots(), "the trials of drivers differ in no factor")
        return figure
    rows = [(number, level) for number, levels in enumerate(found) for level in levels]
    places = [place + 0.5 * number for place, (number, _) in enumerate(rows)]
    names = [
        wrapped(f"{level.factor}={level.name}" + f" ({level.posing})" * bool(level.posing), 1.1)
        for _, level in rows
    ]

    def draw(axis: Axes, row: int, metric: Metric) -> None:
        number, level = rows[row]
        _estimate(axis, places[row], level, metric, style(number).colour)

    return _panels([*METRICS.values()], names, places, 4, draw)


def _panels(
    metrics: list[Metric],
    names: list[str],
    places: Sequence[float],
    columns: int,
    draw: Callable[[Axes, int, Metric], None],
) -> Figure:
    """A panel per metric, with a row for each name at its place."""
    lines = ceil(len(metrics) / columns)
    height_in = lines * (0.7 + row_height_in(names, 0.24) * (places[-1] + 1))
    figure = Figure(figsize=(PAGE_IN, height_in), layout="constrained")
    axes = figure.subplots(lines, columns, sharey=True, squeeze=False)
    for axis, metric in zip(axes.flat, metrics, strict=False):
        for row in range(len(names)):
            draw(axis, row, metric)
        axis.set_xlabel(metric.heading)
    for axis in axes.flat[len(metrics) :]:
        axis.set_visible(False)
    axes[0, 0].set_yticks(places, names)
    axes[0, 0].set_ylim(places[-1] + 0.6, -0.6)
    return figure


def _distribution(axis: Axes, row: int, group: Group, metric: Metric) -> None:
    colour = BLUE if group.setting else HUMAN_STYLE.colour
    if not known(group, metric):
        reference = human_reference(metric)
        if reference is None:
            _remark(axis, row, "no published value")
            return
        axis.plot(reference.value, row, "D", color=colour, ms=4)
        place = (reference.value, row)
        text = f"published {metric.estimator}"
        axis.annotate(text, place, (6, -2), textcoords="offset points", fontsize=6)
        return
    found = values(group, metric).to_numpy(float)
    if not len(found):
        there = group.ended if metric.trials == "ended" else group.finished
        _remark(axis, row, "no trial has it" if len(there) else f"no {metric.trials} trial")
        return
    # Spread by rank, not by chance: the same trials give the same picture.
    spread = row + 0.36 * (np.arange(len(found)) % 7 / 6 - 0.5)
    axis.plot(found, spread, ".", color=colour, ms=1.5, alpha=0.4, rasterized=True)
    axis.boxplot(
        found, positions=[row], orientation="horizontal", widths=0.6, showfliers=False,
        medianprops={"color": colour, "lw": 1.4}, manage_ticks=False,
    )  # fmt: skip


def _estimate(axis: Axes, place: float, level: Level, metric: Metric, colour: str) -> None:
    found = estimate(level.pooled, metric)
    if found.value is None:
        _remark(axis, place, "no trial has it")
        return
    low, high = found.bounds() or (found.value, found.value)
    axis.errorbar(
        found.value, place, xerr=[[found.value - low], [high - found.value]], color=colour,
        marker="o", ms=3, elinewidth=0.8, capsize=1.5, mfc="white", mew=0.8,
    )  # fmt: skip


def _remark(axis: Axes, place: float, text: str) -> None:
    axis.annotate(text, (0.02, place), xycoords=("axes fraction", "data"))


def figure_of_first_actions(study: Study) -> Figure:
    """Means of first actions by own relative velocity, of every driver's baseline prompt."""
    groups = [g for g in (*study.baselines, *study.asked) if g.setting == BASELINE]
    drawn = [(HUMAN_STYLE, "humans", _human_first_actions(study))]
    every = [seat for group in groups for seat in seats(group)]
    for number, seat in enumerate(every):
        drawn.append((style(number), seat.name, _first_actions(study, seat)))
    figure = Figure(figsize=(COLUMN_IN, 2.7), layout="constrained")
    axis = figure.subplots()
    for place, (look, _, means) in enumerate(drawn):
        draw_points(axis, means, 0.04 * place, look)
    axis.set(xlabel="own relative velocity (m/s)", ylabel="first action (m/s²)")
    handles = [key(look, wrapped(name, COLUMN_IN / 2 - 0.4)) for look, name, _ in drawn]
    figure.legend(handles=handles, loc="outside lower center", ncols=2, frameon=False)
    return figure


def _human_first_actions(study: Study) -> list[Point]:
    if study.complete:
        return _first_actions(study, Seat(study.human))
    return [
        Point(
            row.relative_velocity_mps,
            Estimate(row.mean_mps2, *interval(row.mean_mps2, row.se_mps2), row.n),
        )
        for row in published("human_first_actions").itertuples()
    ]


def _first_actions(study: Study, seat: Seat) -> list[Point]:
    by_velocity = first_actions(study, seat).groupby("velocity_mps")
    found = ((float(velocity), mean(rows)) for velocity, rows in by_velocity)
    return [Point(velocity, estimate) for velocity, estimate in found if estimate]


MAKERS: dict[str, Callable[[Study], Figure]] = {
    "figure2": lambda study: figure_2(study, study.baselines),
    "figure2-variants": lambda study: figure_2(study, study.groups),
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
