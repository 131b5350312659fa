"""One recorded trial as it stands in its file, CSV or MAT.

The experiment's recorder wrote series under dotted names, and scalars into the first row alone;
MAT has the same names with underscores. Rows count from 0.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from math import isfinite

from analysis.human.archive import Unreadable
from analysis.human.mat import read_mat
from merge_runner.records import SIDES, Side

POSITIONS: dict[Side, str] = {side: f"travelled_distance.{side}" for side in SIDES}
VELOCITIES: dict[Side, str] = {side: f"velocities.{side}" for side in SIDES}
SERIES = (*POSITIONS.values(), *VELOCITIES.values())
NEEDED = ("dt", "end_state", *SERIES)


@dataclass(frozen=True, slots=True)
class Trace:
    """Both vehicles, one value a sample, in SI units; at least 2 samples, all of them finite.

    ``step_s`` is the time between samples, ``end_state`` the recorder's word for how it ended,
    ``positions_m`` the distances travelled along the own branch.
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
        _require(NEEDED, header)
        rows = [_whole(row, header, number) for number, row in enumerate(reader)]
    except (UnicodeDecodeError, csv.Error) as exc:
        raise Unreadable(f"it is not a CSV table: {exc}") from exc
    places = {name: header.index(name) for name in NEEDED}
    return _trace({name: [row[place] for row in rows] for name, place in places.items()})


def _whole(row: list[str], header: list[str], number: int) -> list[str]:
    if len(row) != len(header):
        raise Unreadable(f"row {number} has {len(row)} of {len(header)} columns: it is cut off")
    return row


def parse_mat(content: bytes) -> Trace:
    """Read a trial's MAT file of version 5; raises Unreadable."""
    variables = read_mat(content)
    names = {name: name.replace(".", "_") for name in NEEDED}
    _require(names.values(), variables)
    return _trace({name: variables[names[name]] for name in NEEDED})


def _require(names: Iterable[str], found: Iterable[str]) -> None:
    if missing := sorted(set(names) - set(found)):
        raise Unreadable(f"it lacks {', '.join(missing)}")


def _trace(columns: Mapping[str, Sequence[float | str]]) -> Trace:
    """Check the columns; of ``dt`` (ms) and ``end_state`` only the first value counts."""
    lengths = {len(columns[name]) for name in SERIES}
    if len(lengths) > 1:
        raise Unreadable(f"its series differ in length: {sorted(lengths)} samples")
    if max(lengths) < 2:
        raise Unreadable("it has fewer than 2 rows")
    steps_ms = _numbers("dt", columns["dt"][:1])
    if not steps_ms or steps_ms[0] <= 0:
        raise Unreadable(f"dt is {steps_ms}, not a time in ms")
    return Trace(
        step_s=steps_ms[0] / 1000,
        end_state=str(next(iter(columns["end_state"]), "")),
        positions_m={side: _numbers(name, columns[name]) for side, name in POSITIONS.items()},
        velocities_mps={side: _numbers(name, columns[name]) for side, name in VELOCITIES.items()},
    )


def _numbers(name: str, values: Sequence[float | str]) -> list[float]:
    try:
        numbers = list(map(float, values))
    except ValueError:
        numbers = []
    if len(numbers) < len(values) or not all(map(isfinite, numbers)):
        row = next(row for row, value in enumerate(values) if not _is_number(value))
        raise Unreadable(f"{name} is {values[row]!r} in row {row}, not a finite number")
    return numbers


def _is_number(value: float | str) -> bool:
    try:
        return isfinite(float(value))
    except ValueError:
        return False
