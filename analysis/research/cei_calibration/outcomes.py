"""Measures of simulated trials, and the published numbers of these measures.

The measures are those of ``trial_metrics`` (measures.sql), computed from arrays, since a search
needs them a thousand times; a test plays trials with the runner and compares.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from analysis.research.cei_calibration.simulation import Traces, Trial
from merge_runner.drivers.cei.collision_interval import exact_bounds
from merge_runner.drivers.cei.motion import Task
from merge_runner.drivers.cei.parameters import TICK_S
from merge_runner.records import SIDES
from merge_runner_analysis.stats.regressions import gap_ols, who_first_logit

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
# Left, right: the sign of what is relative, seen from there.
SIGNS = np.array([1.0, -1.0])


def measured(task: Task, trials: Sequence[Trial], traces: Traces) -> pd.DataFrame:
    """One row a trial, with columns as in ``trials`` and ``trial_metrics``, and four more.

    ``deviation_left_mps`` and ``_right_`` are the largest changes from the initial speeds,
    ``first_left_mps2`` and ``_right_`` the net accelerations over the first 50 ms of control.
    """
    frame = pd.DataFrame(
        {
            "projected_headway_m": [trial.condition.projected_headway_m for trial in trials],
            "relative_velocity_mps": [trial.condition.relative_velocity_mps for trial in trials],
            "status": traces.status,
            "merged_first": _merged_first(task, traces),
            "gap_mean100_m": _gaps(task, traces),
            "conflict_resolution_s": _resolutions(task, traces),
        }
    )
    initial = np.array([trial.condition.speeds_mps for trial in trials]).T
    deviations = np.abs(traces.speeds_mps - initial).max(axis=0)
    columns = np.arange(len(trials))
    now, next_ = (traces.speeds_mps[traces.control_at + k, :, columns].T for k in (0, 1))
    for side, deviation, first in zip(SIDES, deviations, (next_ - now) / TICK_S, strict=True):
        frame[f"deviation_{side}_mps"] = deviation
        frame[f"first_{side}_mps2"] = first
    return frame


def summary(trials: pd.DataFrame) -> dict[tuple[str, str], float]:
    """Return the numbers of the targets by measure and term; a failed fit has none."""
    numbers = {
        ("collisions", "count"): float((trials["status"] == "collided").sum()),
        ("timeouts", "count"): float((trials["status"] == "timeout").sum()),
    }
    fits = {"who_first": who_first_logit(trials), "gap": gap_ols(trials, "gap_mean100_m")}
    for measure, fit in fits.items():
        numbers |= {(measure, name): term.b for name, term in fit.terms.items()}
    resolved = trials[trials["conflict_resolution_s"].notna() & trials["merged_first"].notna()]
    sign = np.where(resolved["merged_first"] == "left", 1.0, -1.0)
    numbers |= _coefficients(
        "conflict_resolution",
        resolved["conflict_resolution_s"].to_numpy(float),
        sign * resolved["projected_headway_m"].to_numpy(float),
        sign * resolved["relative_velocity_mps"].to_numpy(float),
    )
    headway, velocity = (
        np.tile(trials[name].to_numpy(float), 2)
        for name in ("projected_headway_m", "relative_velocity_mps")
    )
    numbers |= _coefficients(
        "deviation", _both(trials, "deviation_{}_mps"), np.abs(headway), np.abs(velocity)
    )
    return numbers | _first_actions(trials)


def _merged_first(task: Task, traces: Traces) -> list[str | None]:
    times = _arrivals(traces.positions_m, task.track.merge_point_m)
    first = np.where(times[0] < times[1], SIDES[0], SIDES[1])
    nobody = np.isinf(times).all(axis=0) | (traces.status == "collided")
    return [None if none else str(side) for side, none in zip(first, nobody, strict=True)]


def _arrivals(positions_m: Array, point_m: float) -> Array:
    """Return the samples in which vehicles reach a point; infinite: never. Shape (2, n)."""
    reached = positions_m >= point_m
    sample = reached.argmax(axis=0)
    before, now = (
        np.take_along_axis(positions_m, np.maximum(sample - k, 0)[None], axis=0)[0] for k in (1, 0)
    )
    moved = np.where(now > before, now - before, 1.0)
    return np.where(reached.any(axis=0), sample - (now - point_m) / moved, np.inf)


def _gaps(task: Task, traces: Traces) -> Array:
    """Net gaps at the first sample with a mean position past the merge point."""
    reached = traces.positions_m.sum(axis=1) >= 2 * task.track.merge_point_m
    apart = np.abs(np.diff(traces.positions_m, axis=1)[:, 0])
    gap = np.take_along_axis(apart, reached.argmax(axis=0)[None], axis=0)[0]
    counts = reached.any(axis=0) & (traces.status == "finished")
    return np.where(counts, gap - task.scenario.vehicle_length_m, np.nan)


def _resolutions(task: Task, traces: Traces) -> Array:
    """Return the times in s after which vehicles are first off a collision course."""
    boxes = task.scenario.vehicle_length_m, task.scenario.vehicle_width_m
    length, track = boxes[0], task.track
    # Just past the contact, since at it boxes do not overlap yet.
    touching = (task.interval.contact_m + 1e-6, track.merge_point_m)
    points = [
        (track.end_m, track.end_m - length, track.end_m + length),
        *((point, *exact_bounds(track, *boxes, point)) for point in touching),
    ]
    course = np.zeros(traces.positions_m.shape[::2], bool)
    for side in (0, 1):
        for point in points:
            course |= _on_course(traces, side, *point)
    samples = np.arange(len(course))[:, None]
    off = ~course & (samples >= traces.control_at) & (samples <= traces.ended_at)
    seconds = (off.argmax(axis=0) - traces.control_at) * TICK_S
    return np.where(off.any(axis=0) & (traces.status != "collided"), seconds, np.nan)


def _on_course(traces: Traces, side: int, at_m: float, low_m: float, high_m: float) -> Mask:
    """Return True where the other will be within the bounds when one vehicle is at the point."""
    position, speed = traces.positions_m[:, side], traces.speeds_mps[:, side]
    moving = (position < at_m) & (speed > 0)
    seconds = np.where(moving, at_m - position, 0.0) / np.where(moving, speed, 1.0)
    other = traces.positions_m[:, 1 - side] + traces.speeds_mps[:, 1 - side] * seconds
    return np.asarray(moving & (low_m <= other) & (other <= high_m))


def _both(trials: pd.DataFrame, column: str) -> Array:
    return np.concatenate([trials[column.format(side)].to_numpy(float) for side in SIDES])


def _coefficients(
    measure: str, values: Array, headway_m: Array, velocity_mps: Array
) -> dict[tuple[str, str], float]:
    """Least squares on headway, relative velocity and their product."""
    design = np.column_stack(
        [np.ones(len(values)), headway_m, velocity_mps, headway_m * velocity_mps]
    )
    fit = np.linalg.lstsq(design, values, rcond=None)[0]
    names = ("intercept", "headway", "relative_velocity", "product")
    return {(measure, name): float(b) for name, b in zip(names, fit, strict=True)}


def _first_actions(trials: pd.DataFrame) -> dict[tuple[str, str], float]:
    """The slope on the own relative velocity; how far vehicles that are slower, or not, differ."""
    velocity = np.outer(SIGNS, trials["relative_velocity_mps"].to_numpy(float)).ravel()
    action = _both(trials, "first_{}_mps2")
    numbers = {("first_action", "slope"): float(np.polyfit(velocity, action, 1)[0])}
    for name, sign in (("slower", -1), ("equal", 0), ("faster", 1)):
        numbers["first_action", f"sd_{name}"] = float(action[np.sign(velocity) == sign].std())
    return numbers
