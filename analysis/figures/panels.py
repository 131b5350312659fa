"""What the figures show, as numbers: traces, and estimates per condition with intervals."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from merge_runner.scenarios.merge.conditions import HUMAN_CONDITIONS
from merge_runner_analysis.data.reference_data import published
from merge_runner_analysis.data.study import Group, Study, of_group
from merge_runner_analysis.metrics import Bounded
from merge_runner_analysis.stats.intervals import mean, proportion
from merge_runner_analysis.stats.regressions import gap_design

Array = NDArray[np.float64]
HUMAN_VELOCITIES_MPS = sorted({c.relative_velocity_mps for c in HUMAN_CONDITIONS.values()})


@dataclass(frozen=True, slots=True)
class Point:
    """A place on an axis, as a projected headway in m, and the estimate there."""

    x: float
    estimate: Bounded


def drawn_groups(study: Study, groups: Iterable[Group]) -> list[Group]:
    """The groups in the conditions that are drawn: humans drove others, too."""
    return [
        group.part(lambda trials: trials["condition"].isin(study.conditions)) for group in groups
    ]


def velocities_mps(study: Study) -> list[float]:
    """The relative velocities that have panels."""
    return sorted({velocity for _, velocity in study.conditions.values()})


def farthest_headway_m(study: Study) -> float:
    """The largest projected headway, to either side, that the panels show."""
    return max(abs(headway_m) for headway_m, _ in study.conditions.values())


def left_first(group: Group, velocity_mps: float) -> list[Point]:
    """Panel C: how often the left vehicle merges first, of finished trials."""
    return [
        Point(headway, proportion(int((known == "left").sum()), len(known)))
        for headway, trials in _conditions(group.outcomes, velocity_mps)
        if len(known := trials["merged_first"].dropna())
    ]


def gaps(group: Group, velocity_mps: float) -> list[Point]:
    """Panel D: mean gap in m; nothing where no traces are known."""
    if not group.measured:
        return []
    return [
        Point(headway, mean(trials["gap_m"].to_numpy(float)))
        for headway, trials in _conditions(group.trials, velocity_mps)
        if trials["gap_m"].notna().any()
    ]


def deviations(group: Group, velocity_mps: float) -> list[Point]:
    """Panel E: mean RMSE of the speed in m/s, two values per trial."""
    if not group.measured:
        return []
    return [
        Point(headway, mean(both))
        for headway, trials in _conditions(group.trials, velocity_mps)
        if len(both := trials[["rmse_left_mps", "rmse_right_mps"]].to_numpy(float).ravel())
    ]


def published_gap_line(velocity_mps: float) -> tuple[Array, Array]:
    """The human regression of the gap as the paper prints it: headways and gaps in m.

    The line spans the headways of the humans' conditions, whatever other conditions were driven.
    """
    farthest_m = max(abs(one.projected_headway_m) for one in HUMAN_CONDITIONS.values())
    headway = np.linspace(-farthest_m, farthest_m, 81)
    terms = published("paper_gap").query("driver == 'human'")["b"].to_numpy(float)
    return headway, gap_design(headway, np.full_like(headway, velocity_mps)) @ terms


def left_traces(study: Study, group: Group, first: str) -> list[Array]:
    """Panels A and B: times in s and left speeds in m/s, (n, 2), where ``first`` merged first.

    Of two different drivers the left one is the ego, as everywhere here.
    """
    if not group.measured:
        return []
    chosen = group.finished[group.finished["merged_first"] == first]
    rows = of_group(study.ego_speeds, group, chosen)
    return [
        np.column_stack(trace) for trace in zip(rows["time_s"], rows["velocity_mps"], strict=True)
    ]


def _conditions(every: pd.DataFrame, velocity_mps: float) -> Iterator[tuple[float, pd.DataFrame]]:
    """The finished trials of each condition with this relative velocity, by headway."""
    finished = every[every["status"] == "finished"]
    chosen = finished[finished["relative_velocity_mps"] == velocity_mps]
    for (headway_m, _), trials in chosen.groupby(["projected_headway_m", "condition"]):
        yield headway_m, trials
