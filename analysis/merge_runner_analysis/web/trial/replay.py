"""Data of a trial's pictures: the replay with its moments, and plans."""

from __future__ import annotations

from bisect import bisect_left
from functools import cache
from typing import Any

from merge_runner.records import SIDES
from merge_runner.scenarios.merge.collision import collided
from merge_runner.scenarios.merge.geometry import TRACK
from merge_runner_analysis.web.display_text import visible
from merge_runner_analysis.web.reading import Row
from merge_runner_analysis.web.trial.account import Account, Course, account
from merge_runner_analysis.web.trial.reader import Trial, controlled
from merge_runner_analysis.web.trial.sentences import outcome_text

# The part of the plane that a picture of the track shows: x, y, width, height in m.
_HALF_M = TRACK.start_distance_m / 2 + 4.5
VIEW_BOX = f"-3 {-_HALF_M:g} {TRACK.end_y_m + 8.8:.1f} {2 * _HALF_M:g}"
DRAWN = {"t": "time_s", "x": "position_m", "v": "velocity_mps", "a": "acceleration_mps2"}


def account_of(row: Row, trial: Trial) -> Account | None:
    """Return the explanation of a trial; None where there is nothing to explain."""
    if row["account"] is None:
        return None
    times, places, speeds = (
        {side: controlled(samples, name) for side, samples in trial.states.items()}
        for name in ("time_s", "position_m", "velocity_mps")
    )
    course = Course(trial.scenario, TRACK, times["left"], places, speeds)
    return account(course, trial.decisions, row)


def replay_data(row: Row, trial: Trial, account: Account | None) -> dict[str, Any]:
    """Return the data of the replay: samples, the track, the bounds of a collision."""
    scenario = trial.scenario
    return {
        "spec": row["spec_hash"],
        "outcome": visible(outcome_text(row)),
        "label": visible(
            f"human {row['pair']}, {row['condition']}"
            if row["source"] == "human"
            else f"{row['model']}, {row['variant']}, {row['condition']}, rep {row['rep']}"
        ),
        "status": row["status"],
        "end": trial.end_s,
        "every": {side: of.interval_steps * scenario.step_s for side, of in trial.paces.items()},
        "sides": {
            side: {short: [round(x, 3) for x in samples[name]] for short, name in DRAWN.items()}
            for side, samples in trial.states.items()
        },
        "bounds": collision_bounds(trial),
        "marks": marks(row, trial, account),
        "track": {
            "tunnel": TRACK.tunnel_exit_m,
            "merge": TRACK.merge_point_m,
            "end": TRACK.end_m,
            "lateral": TRACK.branch_sine,
            "forward": TRACK.branch_cosine,
            "length": scenario.vehicle_length_m,
            "width": scenario.vehicle_width_m,
            "rule": scenario.collision_rule,
            "hardest": scenario.max_acceleration_mps2,
        },
    }


def marks(row: Row, trial: Trial, account: Account | None) -> list[dict[str, Any]]:
    """Return the moments that matter, in order: merges, a collision, the account's moments."""
    moments: list[tuple[float, str, str, str]] = [
        (reached_s, side, "merge", f"{side} merges")
        for side, samples in trial.states.items()
        if (reached_s := reaches_s(samples, TRACK.merge_point_m)) is not None
    ]
    if row["status"] == "collided":
        moments.append((trial.end_s, "", "collision", "crash"))
    if account:
        moments += [(mark.time_s, mark.side, mark.kind, mark.text) for mark in account.marks]
    return [
        {"t": round(time_s, 3), "side": side, "kind": kind, "text": text}
        for time_s, side, kind, text in sorted(moments, key=lambda mark: mark[0])
    ]


def reaches_s(samples: Row, place_m: float) -> float | None:
    """Return when a vehicle is at a place, linear between samples; None where it never is."""
    places, times = samples["position_m"], samples["time_s"]
    i = bisect_left(places, place_m)  # no vehicle drives backwards
    if i in {0, len(places)}:
        return float(times[0]) if i == 0 else None
    part = (place_m - places[i - 1]) / (places[i] - places[i - 1])
    return float(times[i - 1] + part * (times[i] - times[i - 1]))


def collision_bounds(trial: Trial) -> list[float | None]:
    """Return the headway below which the vehicles collide, by sample; None where they cannot.

    To a millimetre, at their mean position: the further apart they are along the road, the less
    they overlap.
    """
    scenario, length_m = trial.scenario, trial.scenario.vehicle_length_m
    places = [samples["position_m"] for samples in trial.states.values()]
    pairs = list(zip(*places, strict=False)) if len(places) == len(SIDES) else []
    if scenario.collision_rule == "shared_lane":
        return [length_m if max(pair) >= TRACK.merge_point_m else None for pair in pairs]
    most_m = length_m + scenario.vehicle_width_m

    @cache
    def bound_m(mean_m: float) -> float | None:
        apart_mm = bisect_left(
            range(round(2000 * most_m)),
            True,
            key=lambda mm: not collided(scenario, TRACK, mean_m + mm / 2000, mean_m - mm / 2000),
        )
        return apart_mm / 1000 or None

    # Where the road is straight the bound stays the same.
    return [bound_m(min(sum(pair) / 2, TRACK.merge_point_m + most_m)) for pair in pairs]


def plan_chart(row: Row, trial: Trial) -> dict[str, Any] | None:
    """Return a plan as steps over its horizon, beside the previous plan for that time.

    None where there is no plan.
    """
    pace, before = trial.paces[row["side"]], row["before"]
    applied = (row["applied"] or []) if row["driven"] else []
    old = (before["plan"] or [])[len(before["applied"]) :] if before else []
    if row["lost"] or not (row["plan"] or old or applied):
        return None
    return {
        "plan": row["plan"] or [],
        "before": old,
        "applied": applied,
        "step_s": pace.action_steps * trial.scenario.step_s,
        "most_mps2": trial.scenario.max_acceleration_mps2,
        "steps": pace.plan_actions,
    }
