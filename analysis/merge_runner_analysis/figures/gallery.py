"""The figures, and how they are written: equal results give equal files."""

from __future__ import annotations

import io
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, Literal

import matplotlib as mpl
from matplotlib.figure import Figure

from merge_runner.errors import UsageError
from merge_runner.study.file import BASELINE
from merge_runner_analysis.figures.figure_2 import (
    COLUMN_IN,
    LINE_IN,
    PAGE_IN,
    Points,
    Style,
    draw_points,
    figure_2,
    key,
    style,
    wrapped,
)
from merge_runner_analysis.published import published
from merge_runner_analysis.stats.estimate import Estimate
from merge_runner_analysis.stats.first_action import Seat, first_actions, mean, seats
from merge_runner_analysis.stats.intervals import interval
from merge_runner_analysis.study import Study

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


def figure_of_first_actions(study: Study) -> Figure:
    """Means of first actions by own relative velocity, of every driver's baseline prompt."""
    groups = [g for g in (*study.baselines, *study.asked) if g.setting == BASELINE]
    drawn = [(Style("#000000", "o"), "humans", _human_first_actions(study))]
    for number, seat in enumerate(seat for group in groups for seat in seats(group)):
        drawn.append((style(number), seat.name, _first_actions(study, seat)))
    labels = [wrapped(name, PAGE_IN - COLUMN_IN - 0.6) for _, name, _ in drawn]
    legend_in = LINE_IN * sum(label.count("\n") + 1.5 for label in labels)
    figure = Figure(figsize=(PAGE_IN, max(2.7, legend_in)), layout="constrained")
    axis = figure.subplots()
    # Beside each other, and far from the next velocity.
    apart_mps = min(0.04, 0.4 / len(drawn))
    for place, (look, _, means) in enumerate(drawn):
        draw_points(axis, means, apart_mps * place, look)
    axis.set(xlabel="own relative velocity (m/s)", ylabel="first action (m/s²)")
    handles = [key(look, label) for (look, _, _), label in zip(drawn, labels, strict=True)]
    figure.legend(handles=handles, loc="outside right center", frameon=False)
    return figure


def _human_first_actions(study: Study) -> Points:
    if study.complete:
        return _first_actions(study, Seat(study.human))
    return [
        (row.relative_velocity_mps, Estimate(mps2, *interval(mps2, row.se_mps2), row.n))
        for row in published("human_first_actions").itertuples()
        for mps2 in (row.mean_mps2,)
    ]


def _first_actions(study: Study, seat: Seat) -> Points:
    by_velocity = first_actions(study, seat).groupby("velocity_mps")
    found = ((float(velocity), mean(rows)) for velocity, rows in by_velocity)
    return [(velocity, estimate) for velocity, estimate in found if estimate]


MAKERS: dict[str, Callable[[Study], Figure]] = {
    "figure2": lambda study: figure_2(study, study.baselines),
    "figure2-variants": lambda study: figure_2(study, study.groups),
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
        MAKERS[name](study).savefig(out, format=form, metadata=METADATA[form])
    return out.getvalue()
