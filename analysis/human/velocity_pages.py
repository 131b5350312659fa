"""Trials of the 11 public velocity pages, one page a condition.

The pages docs/plots/CONDITION.html of github.com/tud-hri/simple-merging-experiment show the speed
of both vehicles of every trial at 20 Hz, from its start: the left vehicle in the first panel, the
right one in the second, drawn solid where it went first, dashed where second, and dotted after a
collision. Positions follow: the experiment moves a vehicle by the mean of its speeds before and
after a step.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import PurePath
from typing import Any

import numpy as np

from merge_runner.records import SIDES, Side
from merge_runner.scenarios.merge.conditions import HUMAN_CONDITIONS
from merge_runner.scenarios.merge.geometry import TRACK
from merge_runner_analysis.data.reference_data import PAIRS
from merge_runner_analysis.human.archive import Unreadable
from merge_runner_analysis.human.plotly import numbers, traces
from merge_runner_analysis.human.record import END_TOLERANCE_M
from merge_runner_analysis.human.trace import Trace

# The pages leave out the letter of a condition.
PAGES = {f"{name.partition('_')[2]}.html": name for name in HUMAN_CONDITIONS}
TRIAL = re.compile(r"([1-9])-([0-9]{1,4})(?:<extra></extra>)?")
PANELS: dict[str, Side] = {"x": "left", "x2": "right"}
FIRST, SECOND, COLLIDED = "solid", "dash", "dot"
TIME_OUT_S = 30.0
# Times are written in s, so that equal steps differ by a rounding.
STEP_TOLERANCE_S = 1e-6
EXPERIMENTS = {int(pair.removeprefix("pair")): experiment for experiment, pair in PAIRS.items()}


def condition_of(name: str) -> str | None:
    """The condition whose page has this file name, or None."""
    file = PurePath(name).name
    return PAGES.get(file) or PAGES.get(file.partition("_")[2])


def trials_of(page: bytes, condition: str) -> Iterator[tuple[int, int, dict[Side, dict[str, Any]]]]:
    """Experiment, iteration and both traces of each trial; raises Unreadable for a whole page."""
    found: dict[tuple[int, int], dict[Side, dict[str, Any]]] = {}
    for trace in traces(page):
        label = TRIAL.fullmatch(_label(trace))
        side = PANELS.get(trace.get("xaxis", "x"))
        if label is None or side is None:
            continue  # the legend has traces of its own
        trial = found.setdefault((EXPERIMENTS[int(label[1])], int(label[2])), {})
        if side in trial:
            raise Unreadable(f"it shows the {side} vehicle of trial {label[0]} twice")
        trial[side] = trace
    if not found:
        raise Unreadable(f"it shows no trial, as the page of {condition} does")
    for (experiment, iteration), trial in sorted(found.items()):
        yield experiment, iteration, trial


def trace_of(trial: dict[Side, dict[str, Any]], condition: str) -> Trace:
    """A trial's trace, with positions from its speeds; raises Unreadable."""
    if missing := [side for side in SIDES if side not in trial]:
        raise Unreadable(f"its {missing[0]} vehicle is not shown")
    times_s = {side: numbers(trial[side], "x") for side in SIDES}
    speeds_mps = {side: numbers(trial[side], "y") for side in SIDES}
    step_s = _step(times_s["left"])
    if any(len(each) != len(times_s["left"]) for each in (*times_s.values(), *speeds_mps.values())):
        raise Unreadable("its vehicles have samples of different times")
    starts_m = HUMAN_CONDITIONS[condition].starts_m(TRACK)
    positions_m = {
        side: start_m + np.concatenate([[0.0], np.cumsum((v[1:] + v[:-1]) / 2 * step_s)])
        for side, start_m, v in zip(SIDES, starts_m, speeds_mps.values(), strict=True)
    }
    return Trace(
        step_s=step_s,
        end_state=_end_state(trial, {side: float(s[-1]) for side, s in positions_m.items()},
                             float(times_s["left"][-1])),
        positions_m={side: list(map(float, s)) for side, s in positions_m.items()},
        velocities_mps={side: list(map(float, v)) for side, v in speeds_mps.items()},
    )  # fmt: skip


def _label(trace: dict[str, Any]) -> str:
    """``pair-iteration``, of the words that the page shows at the pointer."""
    words = trace.get("hovertemplate") or trace.get("text") or ""
    return str(words[0] if isinstance(words, list) else words)


def _step(times_s: np.ndarray) -> float:
    if len(times_s) < 2 or abs(times_s[0]) > STEP_TOLERANCE_S:
        raise Unreadable("it does not begin at 0 s")
    step_s = round(float(times_s[-1]) / (len(times_s) - 1), 9)
    if step_s <= 0 or np.abs(np.diff(times_s) - step_s).max() > STEP_TOLERANCE_S:
        raise Unreadable("its samples are not equally far apart")
    return step_s


def _end_state(trial: dict[Side, dict[str, Any]], ends_m: dict[Side, float], end_s: float) -> str:
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
