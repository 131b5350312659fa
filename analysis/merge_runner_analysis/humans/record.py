"""A recorded trial: read from its CSV file or a velocity page, and converted for the database.

The pages docs/plots/CONDITION.html of github.com/tud-hri/simple-merging-experiment show the speeds
at 20 Hz: the left vehicle in the first panel, the right one in the second, drawn solid where it
went first, dashed where second, dotted after a collision. Positions are their trapezoids, as in the
experiment. Nothing of a page is run.
"""

from __future__ import annotations

import base64
import io
import json
import re
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise
from math import inf
from pathlib import PurePath
from typing import Any

import numpy as np
import pandas as pd

from merge_runner.records import SIDES, Side, canonical_json
from merge_runner.scenarios.merge.conditions import HUMAN_CONDITIONS
from merge_runner.scenarios.merge.geometry import TRACK
from merge_runner.text_safety import one_line
from merge_runner.trial_records import StateRow, Status, TrialRecord, TrialSpec, spec_hash
from merge_runner_analysis.humans.archive import Unreadable
from merge_runner_analysis.humans.imported import VELOCITY_PAGES
from merge_runner_analysis.published import HUMAN_DOI, PAIRS

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
# The spec of the velocity pages, which show no positions.
PAGE_SPEC = canonical_json(
    _READ
    | {
        "origin": VELOCITY_PAGES,
        "position_m": "from the start of the condition by trapezoids of the velocities",
    }
)
PAGE_SPEC_HASH = spec_hash(PAGE_SPEC)
SPECS = {SPEC_HASH: SPEC, PAGE_SPEC_HASH: PAGE_SPEC}
# The pages leave out the letter of a condition.
PAGES = {f"{name.partition('_')[2]}.html": name for name in HUMAN_CONDITIONS}
BEGIN = b"Plotly.newPlot("
TRIAL = re.compile(r"([1-9])-([0-9]{1,4})(?:<extra></extra>)?")
PANELS: dict[str, Side] = {"x": "left", "x2": "right"}
FIRST, SECOND, COLLIDED = "solid", "dash", "dot"
TIME_OUT_S = 30.0
# Times are written in s, so that equal steps differ by a rounding.
STEP_TOLERANCE_S = 1e-6
EXPERIMENTS = {int(pair.removeprefix("pair")): experiment for experiment, pair in PAIRS.items()}
Lines = dict[Side, dict[str, Any]]


@dataclass(frozen=True, slots=True)
class Trace:
    """Both vehicles, one value per sample, in SI units; at least 2 samples, all finite.

    ``end_state`` is the recorder's word, ``positions_m`` are distances along the vehicles'
    branches.
    """

    step_s: float
    end_state: str
    positions_m: dict[Side, list[float]]
    velocities_mps: dict[Side, list[float]]


def parse_csv(content: bytes) -> Trace:
    """Read a trial's CSV file; raises Unreadable."""
    try:
        # Python's own float, since pandas before 3 may miss the last bit.
        exact = dict.fromkeys(SERIES, lambda text: float(text or "nan"))
        table = pd.read_csv(io.BytesIO(content), usecols=NEEDED.__contains__, converters=exact)
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
    """Return the record of a trial; ``page`` is the condition of its page. Raises Unreadable."""
    status = _status(trace)
    condition = _condition(trace)
    if page not in ("", condition):
        raise Unreadable(f"its speeds do not belong to {page}")
    states = tuple(_states(trace))
    pair = PAIRS.get(experiment, f"experiment_{experiment}")
    arrivals = {side: _arrival(trace.positions_m[side]) for side in SIDES}
    first = min(SIDES, key=lambda side: arrivals[side])
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
            kinematics=HUMAN_CONDITIONS[condition],
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
    """Return the condition from whose start the first sample is within the tolerances."""
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
    """Return the steps from the first sample to the merge point; inf if it is never reached."""
    for step, (before, now) in enumerate(pairwise(positions_m)):
        if before < TRACK.merge_point_m <= now:
            return step + (TRACK.merge_point_m - before) / (now - before)
    return inf


def _states(trace: Trace) -> Iterator[StateRow]:
    """Yield every sample; time 0 is the first with both vehicles out of their tunnels."""
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


def condition_of(name: str) -> str | None:
    """Return the condition whose page has this file name, or None."""
    file = PurePath(name).name
    return PAGES.get(file) or PAGES.get(file.partition("_")[2])


def trials_of(page: bytes, condition: str) -> Iterator[tuple[int, int, Lines]]:
    """Yield each trial's experiment, iteration and lines; raises Unreadable for a whole page."""
    trials: dict[tuple[int, int], Lines] = {}
    try:
        # The page holds all of Plotly before the last plot, whose lines are its first list.
        call = page[page.rindex(BEGIN) + len(BEGIN) :].decode("utf-8")
        lines, _ = json.JSONDecoder().raw_decode(call, call.index("["))
        for line in lines:
            # The words that the page shows at the pointer: pair-iteration.
            words = line.get("hovertemplate") or line.get("text") or ""
            label = TRIAL.fullmatch(str(words[0] if isinstance(words, list) else words))
            side = PANELS.get(line.get("xaxis", "x"))
            if label and side:  # the legend has lines of its own
                trial = EXPERIMENTS[int(label[1])], int(label[2])
                trials.setdefault(trial, {})[side] = line
    except (ValueError, AttributeError, TypeError, RecursionError) as exc:
        raise Unreadable("it is no page that Plotly wrote, or is cut off") from exc
    if not trials:
        raise Unreadable(f"it shows no trial, as the page of {condition} does")
    for (experiment, iteration), shown in sorted(trials.items()):
        yield experiment, iteration, shown


def trace_of(trial: Lines, condition: str) -> Trace:
    """Return a trial's trace, with positions from its speeds; raises Unreadable."""
    try:
        numbers = {(axis, side): _numbers(trial[side][axis]) for axis in "xy" for side in SIDES}
        shown = pd.DataFrame(numbers, dtype=float)
    except (KeyError, TypeError, ValueError) as exc:
        raise Unreadable(f"it does not show both vehicles, sample by sample: {exc!r}") from exc
    times_s, velocities = shown["x"].to_numpy(), shown["y"]
    step_s = round(float(times_s[-1, 0]) / max(len(times_s) - 1, 1), 9) if len(times_s) else 0.0
    off_s = np.abs(times_s - np.arange(len(times_s))[:, None] * step_s)
    equal = step_s > 0 and (off_s <= STEP_TOLERANCE_S).all()
    if not equal or not np.isfinite(velocities).all(axis=None):
        raise Unreadable("its samples are no finite numbers at equal steps from 0 s on")
    steps = (velocities + velocities.shift()).fillna(0.0) / 2 * step_s
    positions = steps.cumsum() + list(HUMAN_CONDITIONS[condition].starts_m(TRACK))
    return Trace(
        step_s=step_s,
        end_state=_end_state(trial, dict(positions.iloc[-1]), times_s[-1, 0]),
        positions_m={side: positions[side].tolist() for side in SIDES},
        velocities_mps={side: velocities[side].tolist() for side in SIDES},
    )


def _numbers(values: object) -> object:
    """Return the numbers of a line: a list, or base64 of little-endian ones."""
    if isinstance(values, dict):
        content = base64.b64decode(values["bdata"], validate=True)
        return np.frombuffer(content, np.dtype(values["dtype"]).newbyteorder("<"))
    return values


def _end_state(trial: Lines, ends_m: dict[Side, float], end_s: float) -> str:
    """Return the recorder's word for the end, by the drawn lines and the vehicles' positions."""
    dashes = [(trial[side].get("line") or {}).get("dash", FIRST) for side in SIDES]
    if dashes == [COLLIDED, COLLIDED]:
        return "Collided"
    first = max(SIDES, key=lambda side: ends_m[side])
    if dashes != [FIRST if side == first else SECOND for side in SIDES]:
        raise Unreadable(f"its lines are {' and '.join(dashes)}, but {first} is ahead at the end")
    if ends_m[first] >= TRACK.end_m - END_TOLERANCE_M:
        return "Finished"
    if end_s >= TIME_OUT_S - STEP_TOLERANCE_S:
        return "Time ran out"
    raise Unreadable(f"it ends after {end_s:g} s with no vehicle beyond {ends_m[first]:.1f} m")
