"""One recorded trial, as read from its CSV file.

The experiment's recorder wrote series under dotted names, and scalars only in the first row.
Rows are counted from 0.
"""

from __future__ import annotations

import io
from dataclasses import dataclass

import numpy as np
import pandas as pd

from merge_runner.records import SIDES, Side
from merge_runner.text_safety import one_line
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
        table = pd.read_csv(io.BytesIO(content), usecols=NEEDED.__contains__, dtype=str)
        # pandas' own parser of numbers may miss the last bit.
        numbers = [name for name in table if name != "end_state"]
        table[numbers] = table[numbers].astype(float)
    except (ValueError, MemoryError) as exc:  # pandas' own errors are ValueErrors
        raise Unreadable(f"it is not the CSV table of a trial: {one_line(str(exc))}") from exc
    if missing := sorted(set(NEEDED) - set(table)):
        raise Unreadable(f"it lacks {', '.join(missing)}")
    if len(table) < 2:
        raise Unreadable("it has fewer than 2 rows")
    for name in SERIES:
        if not np.isfinite(table[name]).all():
            row = int(np.argmin(np.isfinite(table[name])))
            raise Unreadable(f"{name} is {table[name][row]} in row {row}, not a finite number")
    step_ms = float(table["dt"][0])
    if not 0 < step_ms < np.inf:
        raise Unreadable(f"dt is {step_ms:g}, not a time in ms")
    return Trace(
        step_s=step_ms / 1000,
        end_state=str(table["end_state"][0]),
        positions_m={side: table[name].tolist() for side, name in POSITIONS.items()},
        velocities_mps={side: table[name].tolist() for side, name in VELOCITIES.items()},
    )
