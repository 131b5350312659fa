"""Trials of the 11 public velocity pages, one page a condition.

The pages docs/plots/CONDITION.html of github.com/tud-hri/simple-merging-experiment show the speed
of both vehicles of every trial at 20 Hz, from its start: the left vehicle in the first panel, the
right one in the second, drawn solid where it went first, dashed where second, and dotted after a
collision. Positions follow: the experiment moves a vehicle by the mean of its speeds before and
after a step. Plotly's ``write_html`` made the pages; nothing of a page is run.
"""

from __future__ import annotations

import base64
import json
import re
from collections.abc import Iterator
from pathlib import PurePath
from typing import Any

import numpy as np
from numpy.typing import NDArray

from merge_runner.records import SIDES, Side
from merge_runner.scenarios.merge.conditions import HUMAN_CONDITIONS
from merge_runner.scenarios.merge.geometry import TRACK
from merge_runner_analysis.data.reference_data import PAIRS
from merge_runner_analysis.human.archive import Unreadable
from merge_runner_analysis.human.record import END_TOLERANCE_M, Trace

# The pages leave out the letter of a condition.
PAGES = {f"{name.partition('_')[2]}.html": name for name in HUMAN_CONDITIONS}
BEGIN = b"Plotly.newPlot("
# The types that Plotly names; the bytes of base64 are little-endian.
DTYPES = {"f8": "<f8", "f4": "<f4", "i4": "<i4", "i2": "<i2", "i1": "i1", "u4": "<u4", "u2": "<u2",
          "u1": "u1"}  # fmt: skip
TRIAL = re.compile(r"([1-9])-([0-9]{1,4})(?:<extra></extra>)?")
PANELS: dict[str, Side] = {"x": "left", "x2": "right"}
FIRST, SECOND, COLLIDED = "solid", "dash", "dot"
TIME_OUT_S = 30.0
# Times are written in s, so that equal steps differ by a rounding.
STEP_TOLERANCE_S = 1e-6
EXPERIMENTS = {int(pair.removeprefix("pair")): experiment for experiment, pair in PAIRS.items()}
Lines = dict[Side, dict[str, Any]]


def condition_of(name: str) -> str | None:
    """The condition whose page has this file name, or None."""
    file = PurePath(name).name
    return PAGES.get(file) or PAGES.get(file.partition("_")[2])


def trials_of(page: bytes, condition: str) -> Iterator[tuple[int, int, Lines]]:
    """Experiment, iteration and both lines of each trial; raises Unreadable for a whole page."""
    try:
        # The page holds all of Plotly before the last plot, whose lines are its first list.
        call = page[page.rindex(BEGIN) + len(BEGIN) :].decode("utf-8")
        lines, _ = json.JSONDecoder().raw_decode(call, call.index("["))
        if not all(isinstance(line, dict) for line in lines):
            raise ValueError("a line is no object")
    except (ValueError, RecursionError) as exc:
        raise Unreadable("it is no page that Plotly wrote, or is cut off") from exc
    trials: dict[tuple[int, int], Lines] = {}
    for line in lines:
        # The words that the page shows at the pointer: pair-iteration.
        words = line.get("hovertemplate") or line.get("text") or ""
        label = TRIAL.fullmatch(str(words[0] if isinstance(words, list) else words))
        side = PANELS.get(line.get("xaxis", "x"))
        if label is None or side is None:
            continue  # the legend has lines of its own
        trial = trials.setdefault((EXPERIMENTS[int(label[1])], int(label[2])), {})
        if side in trial:
            raise Unreadable(f"it shows the {side} vehicle of trial {label[0]} twice")
        trial[side] = line
    if not trials:
        raise Unreadable(f"it shows no trial, as the page of {condition} does")
    for (experiment, iteration), trial in sorted(trials.items()):
        yield experiment, iteration, trial


def trace_of(trial: Lines, condition: str) -> Trace:
    """A trial's trace, with positions from its speeds; raises Unreadable."""
    if missing := [side for side in SIDES if side not in trial]:
        raise Unreadable(f"its {missing[0]} vehicle is not shown")
    times_s, *others = (_numbers(trial[side], axis) for axis in "xy" for side in SIDES)
    if any(len(values) != len(times_s) for values in others):
        raise Unreadable("its vehicles have samples of different times")
    step_s = _step(times_s)
    starts_m = HUMAN_CONDITIONS[condition].starts_m(TRACK)
    velocities_mps = dict(zip(SIDES, others[1:], strict=True))
    positions_m = {
        side: start_m + np.concatenate([[0.0], np.cumsum((v[1:] + v[:-1]) / 2 * step_s)])
        for (side, v), start_m in zip(velocities_mps.items(), starts_m, strict=True)
    }
    return Trace(
        step_s=step_s,
        end_state=_end_state(trial, {side: s[-1] for side, s in positions_m.items()}, times_s[-1]),
        positions_m={side: s.tolist() for side, s in positions_m.items()},
        velocities_mps={side: v.tolist() for side, v in velocities_mps.items()},
    )


def _numbers(line: dict[str, Any], axis: str) -> NDArray[np.float64]:
    """The finite numbers of a line's ``x`` or ``y``: a list, or base64; raises Unreadable."""
    try:
        values = line[axis]
        if isinstance(values, dict):
            content = base64.b64decode(values["bdata"], validate=True)
            values = np.frombuffer(content, DTYPES[values["dtype"]])
        numbers = np.array(values, dtype=float)
    except (KeyError, TypeError, ValueError) as exc:
        raise Unreadable(f"the {axis} of a line is no list of numbers") from exc
    if numbers.ndim != 1 or not np.isfinite(numbers).all():
        raise Unreadable(f"the {axis} of a line is no list of finite numbers")
    return numbers


def _step(times_s: NDArray[np.float64]) -> float:
    if len(times_s) < 2 or abs(times_s[0]) > STEP_TOLERANCE_S:
        raise Unreadable("it does not begin at 0 s")
    step_s = round(float(times_s[-1]) / (len(times_s) - 1), 9)
    if step_s <= 0 or np.abs(np.diff(times_s) - step_s).max() > STEP_TOLERANCE_S:
        raise Unreadable("its samples are not equally far apart")
    return step_s


def _end_state(trial: Lines, ends_m: dict[Side, float], end_s: float) -> str:
    """The recorder's word for the end, of how the lines are drawn and where the vehicles are."""
    dashes = {side: (trial[side].get("line") or {}).get("dash", FIRST) for side in SIDES}
    if set(dashes.values()) == {COLLIDED}:
        return "Collided"
    if set(dashes.values()) != {FIRST, SECOND}:
        raise Unreadable(f"its lines are {' and '.join(dashes.values())}: who went first is open")
    first = max(SIDES, key=lambda side: ends_m[side])
    if dashes[first] != FIRST:
        raise Unreadable(f"its {first} vehicle went second, but is ahead at the end")
    if ends_m[first] >= TRACK.end_m - END_TOLERANCE_M:
        return "Finished"
    if end_s >= TIME_OUT_S - STEP_TOLERANCE_S:
        return "Time ran out"
    raise Unreadable(f"it ends after {end_s:g} s with no vehicle beyond {ends_m[first]:.1f} m")
