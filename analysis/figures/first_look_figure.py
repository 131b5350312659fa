"""What drivers say and do first over headway and relative velocity, where they were only asked."""

from __future__ import annotations

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from analysis.data.first_looks import FirstLooks, first_looks
from analysis.data.study import Study
from analysis.figures.drawing import PAGE_IN, line_count, say, wrapped
from analysis.figures.panels import Array
from analysis.stats.exchange import weighed

ROW_IN = 2.6
# Wider than the values, so that their numbers can be read on the colours.
SHARES, ACTIONS_MPS2 = (-0.4, 1.4), (-1.5, 1.5)


def figure_of_first_looks(study: Study) -> Figure:
    """A row per driver and prompt: the share of M, and the mean first action."""
    found = first_looks(study)
    if not found:
        figure = Figure(figsize=(PAGE_IN, 1.0))
        say(figure.subplots(), "no driver was only asked (merge-runner seat first)")
        return figure
    names = [wrapped(f"{looks.label}/{looks.setting}", PAGE_IN - 1) for looks in found]
    height_in = len(found) * (ROW_IN + 0.12 * line_count(names))
    figure = Figure(figsize=(PAGE_IN, height_in), layout="constrained")
    axes = figure.subplots(len(found), 2, squeeze=False, sharex="row", sharey="row")
    for (words, actions), looks, name in zip(axes, found, names, strict=True):
        _words(words, looks)
        _actions(actions, looks)
        words.set_title(name, loc="left")
        words.set_ylabel("own projected headway (m)")
    return figure


def _words(axis: Axes, looks: FirstLooks) -> None:
    said = looks.words
    axis.set_xlabel("own relative velocity (m/s): share of M")
    if said.empty:
        say(axis, "no tactical word")
        return
    _surface(axis, said.assign(value=(said["tactical"] == "M").astype(float)), SHARES, "RdBu")
    velocities = np.array(sorted(said["velocity_mps"].unique()))
    even = [weighed(looks)[0].indifferent_m(velocity) for velocity in velocities]
    if None not in even:
        low, high = axis.get_ylim()
        axis.plot(velocities, np.array(even, dtype=float), color="black", lw=1, ls="--")
        axis.set_ylim(low, high)


def _actions(axis: Axes, looks: FirstLooks) -> None:
    done = looks.valid
    axis.set_xlabel("own relative velocity (m/s): first action (m/s²)")
    if done.empty:
        say(axis, "no valid answer")
        return
    _surface(axis, done.assign(value=done["action_mps2"]), ACTIONS_MPS2, "PuOr")


def _surface(axis: Axes, rows: pd.DataFrame, limits: tuple[float, float], colours: str) -> None:
    """The mean values at their points as fields, each with its number."""
    means = rows.groupby(["headway_m", "velocity_mps"])["value"].mean()
    table = means.unstack("velocity_mps")
    x, y = table.columns.to_numpy(float), table.index.to_numpy(float)
    axis.pcolormesh(
        _edges(x), _edges(y), table.to_numpy(float), vmin=limits[0], vmax=limits[1], cmap=colours,
        edgecolor="white", lw=0.5,
    )  # fmt: skip
    for (headway_m, velocity_mps), value in means.items():
        axis.text(velocity_mps, headway_m, f"{value:.2f}", ha="center", va="center", fontsize=5)
    axis.set_xticks(x)
    axis.set_yticks(y)


def _edges(values: Array) -> Array:
    """The edges of fields around ascending values."""
    middles = (values[1:] + values[:-1]) / 2
    half = middles[0] - values[0] if len(middles) else 0.5
    last = values[-1] - middles[-1] if len(middles) else 0.5
    return np.array([values[0] - half, *middles, values[-1] + last])
