"""First actions: their means by own relative velocity, and their distributions."""

from __future__ import annotations

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from analysis.data.first_actions import Acts
from analysis.data.study import Study
from analysis.figures.drawing import PAGE_IN, key, letter, wrapped
from analysis.figures.styles import HUMAN_STYLE, Style, driver_style
from analysis.stats.first_look import (
    GRID,
    Coefficient,
    Humans,
    Seat,
    acts,
    clustered_mean,
    ecdf,
    humans,
    seats,
)
from analysis.tables.first_action import velocity_name

COLUMNS = 4
SHOWN_MPS2 = (-2.6, 2.6)


def figure_of_first_actions(study: Study) -> Figure:
    """Means with intervals (A), and the share of actions below each acceleration (B to D)."""
    known = humans(study)
    drivers = [seat for group in study.baselines if group.setting for seat in seats(group)]
    figure = Figure(figsize=(PAGE_IN, 2.7), layout="constrained")
    axes = figure.subplots(1, 1 + len(known.velocities))
    _draw_humans(axes, known)
    for number, seat in enumerate(drivers):
        _draw_driver(axes, study, seat, known, driver_style(number), number + 1)
    axes[0].set(xlabel="own relative velocity (m/s)", ylabel="first action (m/s²)")
    for axis, velocity, name in zip(axes[1:], known.velocities, "BCD", strict=False):
        axis.set(xlabel="first action (m/s²)", xlim=SHOWN_MPS2, ylim=(0, 1))
        axis.set_title(velocity_name(velocity))
        letter(axis, name, 1.06)
    axes[1].set_ylabel("share below")
    letter(axes[0], "A", 1.06)
    names = [(HUMAN_STYLE, f"humans, {known.source}")]
    names += [(driver_style(number), seat.name) for number, seat in enumerate(drivers)]
    handles = [key(style, wrapped(name, PAGE_IN / COLUMNS - 0.4)) for style, name in names]
    figure.legend(handles=handles, loc="outside lower center", ncols=COLUMNS, frameon=False)
    return figure


def _draw_humans(axes: list[Axes], known: Humans) -> None:
    for axis, velocity in zip(axes[1:], known.velocities, strict=True):
        axis.plot(GRID, known.cdf[velocity], color=HUMAN_STYLE.colour, lw=1.2)
    means = {v: Coefficient(one.mean, one.se) for v, one in known.classes.items()}
    _draw_means(axes[0], means if known.acts is None else _means(known.acts), HUMAN_STYLE, 0)


def _draw_driver(
    axes: list[Axes], study: Study, seat: Seat, known: Humans, style: Style, place: int
) -> None:
    found = acts(study, seat)
    first = found.first[:, found.sides]
    for axis, velocity in zip(axes[1:], known.velocities, strict=True):
        if found.at(velocity).any():
            cdf = ecdf(first[found.at(velocity)])
            axis.plot(GRID, cdf, color=style.colour, lw=0.9, drawstyle="steps-post")
    _draw_means(axes[0], _means(found), style, place)


def _means(found: Acts) -> dict[float, Coefficient]:
    first = found.first[:, found.sides]
    return {v: clustered_mean(first, found.at(v), found.unit) for v in found.velocities}


def _draw_means(axis: Axes, means: dict[float, Coefficient], style: Style, place: int) -> None:
    """Side by side, so that intervals do not hide each other."""
    for velocity, one in means.items():
        low, high = one.bounds() or (one.value, one.value)
        axis.errorbar(
            velocity + 0.04 * place, one.value, yerr=[[one.value - low], [high - one.value]],
            color=style.colour, marker=style.marker, ms=3, elinewidth=0.8, capsize=1.5, mfc="white",
            mew=0.8,
        )  # fmt: skip
    axis.plot(
        [velocity + 0.04 * place for velocity in means],
        [one.value for one in means.values()],
        color=style.colour,
        lw=0.8,
    )
