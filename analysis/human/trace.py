"""One recorded trial, as read from its CSV file.

The experiment's recorder wrote series under dotted names, and scalars only in the first row.
Rows are counted from 0.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import isfinite

from merge_runner.records import SIDES, Side
from merge_runner_analysis.human.archive import Unreadable

POSITIONS: dict[Side, str] = {side: f"travelled_distance.{side}" for side in SIDES}
VELOCITIES: dict[Side, str] = {side: f"velocities.{side}" for side in SIDES}
SERIES = (*POSITIONS.values(), *VELOCITIES.values())
NEEDED = ("dt", "end_state", *SERIES)


@dataclass(frozen=True, slots=True)
class Trace:
    """Both vehicles, one value per sample, in SI units; at least 2 samples, all finite.

    ``step_s`` is the time between samples, ``end_state`` the recorder's word for how the trial
    ended, ``positions_m`` the distances that each vehicle travelled along its own branch.
    """

    step_s: float
    end_state: str
    positions_m: dict[Side, list[float]]
    velocities_mps: dict[Side, list[float]]


def parse_csv(content: bytes) -> Trace:
    """Read a trial's CSV file; raises Unreadable."""
    try:
        lines = io.StringIO(content.decode("utf-8-sig"), newline="")
        # Checked row by row: a small download can unpack to many rows of nothing.
        reader = filter(None, csv.reader(lines, strict=True))
        header = next(reader, [])
        if missing := sorted(set(NEEDED) - set(header)):
            raise Unreadable(f"it lacks {', '.join(missing)}")
        rows = [_whole(row, header, number) for number, row in enumerate(reader)]
    except (UnicodeDecodeError, csv.Error) as exc:
        raise Unreadable(f"it is not a CSV table: {exc}") from exc
    places = {name: header.index(name) for name in NEEDED}
    return _trace({name: [row[place] for row in rows] for name, place in places.items()})


def _whole(row: list[str], header: list[str], number: int) -> list[str]:
    if len(row) != len(header):
        raise Unreadable(f"row {number} has {len(row)} of {len(header)} columns: it is cut off")
    return row


def _trace(columns: Mapping[str, Sequence[str]]) -> Trace:
    """Check the columns; of ``dt`` (ms) and ``end_state`` only the first value counts."""
    if len(columns["dt"]) < 2:
        raise Unreadable("it has fewer than 2 rows")
    (step_ms,) = _numbers("dt", columns["dt"][:1])
    if step_ms <= 0:
        raise Unreadable(f"dt is {step_ms:g}, not a time in ms")
    return Trace(
        step_s=step_ms / 1000,
        end_state=columns["end_state"][0],
        positions_m={side: _numbers(name, columns[name]) for side, name in POSITIONS.items()},
        velocities_mps={side: _numbers(name, columns[name]) for side, name in VELOCITIES.items()},
    )


def _numbers(name: str, values: Sequence[str]) -> list[float]:
    try:
        numbers = list(map(float, values))
    except ValueError:
        numbers = []
    if len(numbers) < len(values) or not all(map(isfinite, numbers)):
        row = next(row for row, value in enumerate(values) if not _is_number(value))
        raise Unreadable(f"{name} is {values[row]!r} in row {row}, not a finite number")
    return numbers


def _is_number(value: str) -> bool:
    try:
        return isfinite(float(value))
    except ValueError:
        return False
