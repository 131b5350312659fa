"""First actions: their means by own relative velocity."""

from __future__ import annotations

from itertools import count

from matplotlib.figure import Figure

from merge_runner_analysis.data.reference_data import published
from merge_runner_analysis.data.study import Study
from merge_runner_analysis.figures.drawing import COLUMN_IN, draw_points, key, wrapped
from merge_runner_analysis.figures.panels import Point
from merge_runner_analysis.figures.styles import HUMAN_STYLE, driver_style
from merge_runner_analysis.names import BASELINE
from merge_runner_analysis.stats.first_action import Seat, first_actions, mean, seats
from merge_runner_analysis.stats.intervals import Estimate, interval

COLUMNS = 2


def figure_of_first_actions(study: Study) -> Figure:
    """Draw the means of every driver with the baseline prompt, with intervals."""
    asked = [group for group in study.asked if group.setting == BASELINE]
    played = [group for group in study.baselines if group.setting]
    figure = Figure(figsize=(COLUMN_IN, 2.7), layout="constrained")
    axis = figure.subplots()
    drawn = [(HUMAN_STYLE, "humans", _of_humans(study))]
    drawn += [
        (style, seat.name, _means(study, seat))
        for style, seat in zip(
            map(driver_style, count()),
            (seat for group in (*played, *asked) for seat in seats(group)),
            strict=False,
        )
    ]
    for place, (style, _, means) in enumerate(drawn):
        draw_points(axis, means, 0.04 * place, style)
    axis.set(xlabel="own relative velocity (m/s)", ylabel="first action (m/s²)")
    handles = [key(style, wrapped(name, COLUMN_IN / COLUMNS - 0.4)) for style, name, _ in drawn]
    figure.legend(handles=handles, loc="outside lower center", ncols=COLUMNS, frameon=False)
    return figure


def _of_humans(study: Study) -> list[Point]:
    if study.complete:
        return _means(study, Seat(study.human, (0, 1)))
    return [
        Point(
            row.relative_velocity_mps,
            Estimate(row.mean_mps2, *interval(row.mean_mps2, row.se_mps2), row.n),
        )
        for row in published("human_first_actions").itertuples()
    ]


def _means(study: Study, seat: Seat) -> list[Point]:
    by_velocity = first_actions(study, seat).groupby("velocity_mps")
    found = ((float(velocity), mean(rows)) for velocity, rows in by_velocity)
    return [Point(velocity, estimate) for velocity, estimate in found if estimate]
