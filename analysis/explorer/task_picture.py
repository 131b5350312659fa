"""The picture of the task: the track from above, and both vehicles on their way to the merge."""

from __future__ import annotations

from typing import Any

from merge_runner.config import ScenarioConfig
from merge_runner.records import SIDES, Side
from merge_runner.scenarios.merge.conditions import HUMAN_CONDITIONS, MEAN_SPEED_MPS, Condition
from merge_runner.scenarios.merge.geometry import TRACK
from merge_runner_analysis.explorer.catalogue import Catalogue
from merge_runner_analysis.explorer.conditions import ordered
from merge_runner_analysis.explorer.views import condition_text, view_box

# The sizes of vehicles in the trials of drivers, the commonest last.
SIZES = """
SELECT length_m, width_m, count(*) AS trials FROM listed JOIN geometry USING (spec_hash)
WHERE who <> 'humans' GROUP BY ALL ORDER BY trials, length_m, width_m
"""
CONDITIONS = """
SELECT condition, any_value(projected_headway_m), any_value(relative_velocity_mps)
FROM listed WHERE who <> 'humans' GROUP BY ALL
"""
# The condition that is shown where it was played, or nothing was.
USUAL = "L_4_0"


def task_picture(catalogue: Catalogue) -> dict[str, Any]:
    """Return the task in m, with the vehicles of most trials of drivers, who drive to the right.

    ``meet``: at constant speeds the vehicles collide in all conditions that were played.
    """
    usual = ScenarioConfig()
    length_m, width_m, trials = usual.vehicle_length_m, usual.vehicle_width_m, 0
    rows = catalogue.ask(SIZES)
    if rows:
        length_m, width_m, trials = rows[-1].values()
    played = {
        name: Condition(headway, velocity, max(MEAN_SPEED_MPS, abs(velocity)))
        for name, headway, velocity in map(dict.values, catalogue.ask(CONDITIONS))
    } or {USUAL: HUMAN_CONDITIONS[USUAL]}
    name = USUAL if USUAL in played else ordered(played)[0]
    shown = played[name]
    return {
        "view_box": view_box(),
        "branches": {side: _path(side) for side in SIDES},
        "tunnels": {
            side: [_point(side, at) for at in (0.0, TRACK.tunnel_exit_m)] for side in SIDES
        },
        "merge_m": round(TRACK.merge_y_m, 2),
        "vehicles": _vehicles(shown),
        "length_m": length_m,
        "width_m": width_m,
        "alone_m": TRACK.merge_point_m - TRACK.tunnel_exit_m,
        "condition": name,
        "words": condition_text(shown.projected_headway_m, shown.relative_velocity_mps),
        "meet": all(abs(one.projected_headway_m) < length_m for one in played.values()),
        "sizes": len(rows),
        "trials": trials,
        "all_trials": sum(row["trials"] for row in rows),
    }


def _vehicles(condition: Condition) -> list[dict[str, Any]]:
    """Where both are at constant speeds, a third of the way from the tunnels to the merge."""
    speeds, starts = condition.speeds_mps, condition.starts_m(TRACK)
    merge_s = min(
        (TRACK.merge_point_m - start) / speed for start, speed in zip(starts, speeds, strict=True)
    )
    free_s = max(condition.exit_times_s(TRACK))
    places = condition.positions_m(free_s + (merge_s - free_s) / 3, TRACK)
    vehicles = []
    for side, position_m in zip(SIDES, places, strict=True):
        x, y = _point(side, position_m)
        sine, cosine = TRACK.heading(side, position_m)
        matrix = f"{cosine:.4f} {sine:.4f} {-sine:.4f} {cosine:.4f}"
        vehicles.append({"side": side, "x": x, "y": y, "matrix": matrix})
    return vehicles


def _path(side: Side) -> str:
    points = [_point(side, at) for at in (0.0, TRACK.merge_point_m, TRACK.end_m)]
    return " ".join(f"{x},{y}" for x, y in points)


def _point(side: Side, position_m: float) -> tuple[float, float]:
    across, along = TRACK.place(side, position_m)
    return round(along, 2), round(across, 2)
