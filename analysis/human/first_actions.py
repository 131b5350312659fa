"""First actions of humans: from the published page, whose conditions are decoded, or from a CSV.

The page docs/plots/initial_action.html of github.com/tud-hri/simple-merging-experiment shows the
net acceleration of both vehicles at the first sample under control, and who went first, but not the
condition. The cruise control holds a speed that depends on the condition, drag depends on the
speed, and the pedal has 8 bits: only with the right speeds do both pedals lie on its grid.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Iterator
from dataclasses import dataclass
from math import isfinite, sqrt

import numpy as np
from numpy.typing import NDArray

from analysis.human.archive import Unreadable
from analysis.human.plotly import numbers, traces
from merge_runner.records import Side
from merge_runner.scenarios.merge.conditions import HUMAN_CONDITIONS, MEAN_SPEED_MPS
from merge_runner.scenarios.merge.vehicle import net_acceleration

Array = NDArray[np.float64]

STEP_S = 0.05
MAX_MPS2 = 2.5
# What the vehicle can do by itself or against its drag, either way.
LIMIT_MPS2 = -net_acceleration(-MAX_MPS2, MEAN_SPEED_MPS + 0.4, "human")
# The cruise control's gain, of the pedal on the speed error.
GAIN = 5.0
# Steps of the pedal above and below its middle, which is half of the way.
ABOVE, BELOW = 128, 126
# How far, in steps, both pedals may be off the grid, and must be for other speeds.
FITS, FITS_NOT = 0.012, 0.02
FIRST: dict[str, Side | None] = {"left": "left", "right": "right", "collision": None}
COLUMNS = ("relative_velocity_mps", "merged_first", "left_mps2", "right_mps2")
VELOCITIES = sorted({one.relative_velocity_mps for one in HUMAN_CONDITIONS.values()})


@dataclass(frozen=True, slots=True)
class FirstActions:
    """A trial: its relative velocity, left minus right, who merged first, net accelerations."""

    relative_velocity_mps: float
    merged_first: Side | None
    left_mps2: float
    right_mps2: float


def read_first_actions(content: bytes) -> tuple[list[FirstActions], int]:
    """The trials of a page or of a CSV, and how many were left out; raises Unreadable."""
    if content.lstrip()[:1] == b"<":
        return _of_page(content)
    trials = list(_of_csv(content))
    if not trials:
        raise Unreadable("it holds no first action")
    return trials, 0


def rows_of(trials: list[FirstActions]) -> list[tuple[int, str, float, Side | None, float]]:
    """Rows of the table ``human_first_actions``."""
    return [
        (number, side, one.relative_velocity_mps, one.merged_first, action)
        for number, one in enumerate(trials, 1)
        for side, action in (("left", one.left_mps2), ("right", one.right_mps2))
    ]


def cruise_speed(nominal_mps: float) -> float:
    """The speed at which the cruise control settles: there its pedal balances the drag.

    12.5 (nominal - v) = 0.5 + 0.005 v².
    """
    drag, gain = 0.005, GAIN * MAX_MPS2
    return (sqrt(gain**2 - 4 * drag * (0.5 - gain * nominal_mps)) - gain) / (2 * drag)


def pedal(net_mps2: Array, cruise_mps: float) -> Array:
    """The pedal, -1 to 1, that gives this recorded net acceleration from a cruise speed.

    The recorder takes the drag of the speed after the step.
    """
    drag = net_acceleration(0.0, cruise_mps, "human")
    commanded = net_mps2 - drag
    for _ in range(5):  # each time the error is a 200th
        after = cruise_mps + STEP_S * (commanded + drag)
        commanded = net_mps2 + 0.5 + 0.005 * after**2
    return np.asarray(commanded / MAX_MPS2)


def off_grid(positions: Array) -> Array:
    """How far pedals are from the 8-bit grid, in its steps; infinite for a brake."""
    apart = positions - 0.5
    steps = 2 * apart * np.where(apart >= 0, ABOVE, BELOW)
    away = np.abs(steps - steps.round())
    return np.where((positions < -0.5 * FITS / BELOW) | (positions > 1.001), np.inf, away)


def decoded(left_mps2: Array, right_mps2: Array) -> Array:
    """The relative velocity of each trial, NaN where the pedals do not tell it."""
    misfits = np.stack([_misfit(left_mps2, right_mps2, velocity) for velocity in VELOCITIES])
    best, second = np.sort(misfits, axis=0)[:2]
    told = (best <= FITS) & (second > FITS_NOT)
    return np.where(told, np.array(VELOCITIES)[misfits.argmin(axis=0)], np.nan)


def _misfit(left_mps2: Array, right_mps2: Array, velocity_mps: float) -> Array:
    speeds = (MEAN_SPEED_MPS + velocity_mps / 2, MEAN_SPEED_MPS - velocity_mps / 2)
    pedals = (
        pedal(net, cruise_speed(speed))
        for net, speed in zip((left_mps2, right_mps2), speeds, strict=True)
    )
    return np.maximum(*map(off_grid, pedals))


def _of_page(content: bytes) -> tuple[list[FirstActions], int]:
    found: list[FirstActions] = []
    left_out = 0
    for trace in traces(content):
        name = str(trace.get("name", "")).lower()
        if name not in FIRST:
            continue  # the diagonal
        left, right = numbers(trace, "x"), numbers(trace, "y")
        if len(left) != len(right):
            raise Unreadable(f"its trace {name} has {len(left)} x and {len(right)} y")
        velocities = decoded(left, right)
        left_out += int(np.isnan(velocities).sum())
        found += [
            FirstActions(float(velocity), FIRST[name], float(one), float(other))
            for velocity, one, other in zip(velocities, left, right, strict=True)
            if not np.isnan(velocity)
        ]
    if not found:
        raise Unreadable("it shows no first actions whose pedals tell their condition")
    return found, left_out


def _of_csv(content: bytes) -> Iterator[FirstActions]:
    try:
        rows = csv.DictReader(io.StringIO(content.decode("utf-8-sig"), newline=""), strict=True)
        missing = [name for name in COLUMNS if name not in (rows.fieldnames or ())]
        if missing:
            raise Unreadable(f"it lacks {', '.join(missing)}; the columns are {', '.join(COLUMNS)}")
        for number, row in enumerate(rows, 1):
            yield _of_row(row, number)
    except (UnicodeDecodeError, csv.Error) as exc:
        raise Unreadable(f"it is neither a page nor a CSV table: {exc}") from exc


def _of_row(row: dict[str, str], number: int) -> FirstActions:
    first = (row["merged_first"] or "collision").lower()
    if first not in FIRST:
        raise Unreadable(f"merged_first is {first!r} in row {number}; valid: left, right, empty")
    values = [_number(row, name, number) for name in COLUMNS if name != "merged_first"]
    if values[0] not in VELOCITIES:
        valid = ", ".join(f"{velocity:g}" for velocity in VELOCITIES)
        raise Unreadable(f"relative_velocity_mps is {values[0]:g} in row {number}; valid: {valid}")
    beyond = max(values[1:], key=abs)
    if abs(beyond) > LIMIT_MPS2:
        raise Unreadable(
            f"an acceleration is {beyond:g} m/s² in row {number}: the vehicle of the experiment "
            f"can do {LIMIT_MPS2:.2f} at most, drag included"
        )
    return FirstActions(values[0], FIRST[first], values[1], values[2])


def _number(row: dict[str, str], name: str, number: int) -> float:
    try:
        value = float(row[name])
    except (TypeError, ValueError):
        value = float("nan")
    if not isfinite(value):
        raise Unreadable(f"{name} is {row[name]!r} in row {number}, not a finite number")
    return value
