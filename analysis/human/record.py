"""A recorded trial: read from its CSV file, and converted for the database.

The experiment's recorder wrote series under dotted names, and scalars only in the first row.
"""

from __future__ import annotations

import io
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise
from math import inf

import numpy as np
import pandas as pd

from merge_runner.records import (
    SIDES,
    Side,
    StateRow,
    Status,
    TrialRecord,
    TrialSpec,
    canonical_json,
    spec_hash,
)
from merge_runner.scenarios.merge.conditions import HUMAN_CONDITIONS
from merge_runner.scenarios.merge.geometry import TRACK
from merge_runner.text_safety import one_line
from merge_runner_analysis.data.imported_humans import VELOCITY_PAGES
from merge_runner_analysis.data.reference_data import HUMAN_DOI, PAIRS
from merge_runner_analysis.human.archive import Unreadable

POSITIONS: dict[Side, str] = {side: f"travelled_distance.{side}" for side in SIDES}
VELOCITIES: dict[Side, str] = {side: f"velocities.{side}" for side in SIDES}
SERIES = (*POSITIONS.values(), *VELOCITIES.values())
NEEDED = ("dt", "end_state", *SERIES)
STATUSES: dict[str, Status] = {
    "Finished": "finished",
    "Collided": "collided",
    "Time ran out": "timeout",
    "Beyond track bounds": "failed",
}
# A recording may begin one step late: up to 0.52 m and 0.05 m/s from the start of its condition.
START_TOLERANCE_M = 0.6
START_TOLERANCE_MPS = 0.1
# The experiment ended at a position, which differs from the distance travelled by some millimetres.
END_TOLERANCE_M = 1.0
_READ = {
    "spec_version": 1,
    "source": "human",
    "doi": HUMAN_DOI,
    "condition": "the one whose start is at most "
    f"{START_TOLERANCE_M} m and {START_TOLERANCE_MPS} m/s from the first sample",
    "time_s": f"from the first sample with both vehicles beyond {TRACK.tunnel_exit_m:g} m",
    "position_m": "travelled_distance",
    "velocity_mps": "velocities",
    "acceleration_mps2": "difference of velocities over the step before",
    "merged_first": f"at {TRACK.merge_point_m:g} m, interpolated within the step",
}
SPEC = canonical_json(_READ)
SPEC_HASH = spec_hash(SPEC)
# Of the velocity pages, which show no positions.
PAGE_SPEC = canonical_json(
    _READ
    | {
        "origin": VELOCITY_PAGES,
        "position_m": "from the start of the condition by trapezoids of the velocities",
    }
)
PAGE_SPEC_HASH = spec_hash(PAGE_SPEC)
SPECS = {SPEC_HASH: SPEC, PAGE_SPEC_HASH: PAGE_SPEC}


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
            row = int(np.argmin(np.isfinite(table[name])))  # the first is 0
            raise Unreadable(f"{name} is {table[name][row]} in row {row}, not a finite number")
    step_ms = float(table["dt"][0])
    if not 0 < step_ms < inf:
        raise Unreadable(f"dt is {step_ms:g}, not a time in ms")
    return Trace(
        step_s=step_ms / 1000,
        end_state=str(table["end_state"][0]),
        positions_m={side: table[name].tolist() for side, name in POSITIONS.items()},
        velocities_mps={side: table[name].tolist() for side, name in VELOCITIES.items()},
    )


def trial_record(trace: Trace, experiment: int, iteration: int, page: str = "") -> TrialRecord:
    """The record of trial ``iteration`` of an experiment; raises Unreadable.

    ``page`` is the condition of the velocity page that shows it.
    """
    status = _status(trace)
    condition = _condition(trace)
    if page not in ("", condition):
        raise Unreadable(f"its speeds are not those of {page}")
    states = tuple(_states(trace))
    pair = PAIRS.get(experiment, f"experiment_{experiment}")
    arrivals = {side: _arrival(trace.positions_m[side]) for side in SIDES}
    first = min(arrivals, key=arrivals.__getitem__)
    decided = status not in ("collided", "failed") and arrivals[first] < inf
    return TrialRecord(
        spec=TrialSpec(
            trial_id=f"human/{pair}/{condition}/iter{iteration:03d}",
            spec_hash=PAGE_SPEC_HASH if page else SPEC_HASH,
            source="human",
            pair=pair,
            model_left="human",
            model_right="human",
            variant=None,
            condition=condition,
            repetition=iteration,
            sample_set=0,
            order=0,
        ),
        status=status,
        merged_first=first if decided else None,
        end_time_s=states[-1].time_s,
        error=trace.end_state if status == "failed" else None,
        states=states,
        decisions=(),
    )


def _status(trace: Trace) -> Status:
    status = STATUSES.get(trace.end_state)
    if status is None:
        raise Unreadable(f"end_state is {trace.end_state!r}; known: {', '.join(STATUSES)}")
    farthest = max(trace.positions_m[side][-1] for side in SIDES)
    if status == "finished" and farthest < TRACK.end_m - END_TOLERANCE_M:
        raise Unreadable(f"it is Finished, but ends with no vehicle beyond {farthest:.1f} m")
    return status


def _condition(trace: Trace) -> str:
    """The condition from whose start the first sample is within the tolerances."""
    at_m = [trace.positions_m[side][0] for side in SIDES]
    mps = [trace.velocities_mps[side][0] for side in SIDES]
    for name, condition in HUMAN_CONDITIONS.items():
        off_m = np.abs(np.subtract(at_m, condition.starts_m(TRACK)))
        off_mps = np.abs(np.subtract(mps, condition.speeds_mps))
        if off_m.max() <= START_TOLERANCE_M and off_mps.max() <= START_TOLERANCE_MPS:
            return name
    shown = (f"{s} at {m:.2f} m with {v:.2f} m/s" for s, m, v in zip(SIDES, at_m, mps, strict=True))
    raise Unreadable(f"it starts like none of the conditions: {', '.join(shown)}")


def _arrival(positions_m: list[float]) -> float:
    """When a vehicle reaches the merge point, in steps from the first sample; inf: never."""
    for step, (before, now) in enumerate(pairwise(positions_m)):
        if before < TRACK.merge_point_m <= now:
            return step + (TRACK.merge_point_m - before) / (now - before)
    return inf


def _states(trace: Trace) -> Iterator[StateRow]:
    """Every sample; time 0 is the first with both vehicles out of their tunnels."""
    places = zip(*trace.positions_m.values(), strict=True)
    out = (sample for sample, both in enumerate(places) if min(both) > TRACK.tunnel_exit_m)
    if (start := next(out, None)) is None:
        raise Unreadable(
            f"its vehicles are never both beyond the tunnels ({TRACK.tunnel_exit_m:g} m)"
        )
    for sample in range(len(trace.positions_m["left"])):
        # Rounded, because a product like 3 * 0.05 is not exactly 0.15 in binary.
        step, time_s = sample - start, round((sample - start) * trace.step_s, 9)
        for side in SIDES:
            mps = trace.velocities_mps[side]
            acceleration_mps2 = (mps[sample] - mps[max(sample - 1, 0)]) / trace.step_s
            position_m = trace.positions_m[side][sample]
            yield StateRow(step, time_s, side, position_m, mps[sample], acceleration_mps2)
