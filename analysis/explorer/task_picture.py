"""The picture of the task: the track from above, and both vehicles on their way to the merge."""

from __future__ import annotations

import json
from contextlib import suppress
from typing import Any

from analysis.explorer.catalogue import Catalogue
from analysis.explorer.conditions import ordered
from analysis.explorer.views import condition_text, view_box
from merge_runner.config import ScenarioConfig
from merge_runner.errors import UsageError
from merge_runner.records import SIDES, Side
from merge_runner.scenarios.merge.conditions import HUMAN_CONDITIONS, MEAN_SPEED_MPS, Condition
from merge_runner.scenarios.merge.geometry import TRACK, Track, track_of

# What the trials of drivers were driven on, the commonest last.
GEOMETRIES = """
SELECT (spec->'$.track')::VARCHAR AS track, length_m, width_m, count(*) AS trials
FROM listed JOIN specs USING (spec_hash) JOIN geometry USING (spec_hash)
WHERE who <> 'humans' GROUP BY ALL ORDER BY trials, track, length_m, width_m
"""
CONDITIONS = """
SELECT condition, any_value(projected_headway_m), any_value(relative_velocity_mps)
FROM listed WHERE who <> 'humans' GROUP BY ALL
"""
# The condition that is shown where it was played, or nothing was.
USUAL = "L_4_0"


def task_picture(catalogue: Catalogue) -> dict[str, Any]:
    """The geometry of most trials of drivers, in m; as in a replay all drive to the right.

    ``meet``: at constant speeds the vehicles collide in all conditions that were played.
    """
    usual = ScenarioConfig()
    track, length_m, width_m, trials = TRACK, usual.vehicle_length_m, usual.vehicle_width_m, 0
    rows = catalogue.ask(GEOMETRIES)
    for row in rows:
        with suppress(UsageError):  # the audit tells of a spec without a track
            track = track_of({} if row["track"] is None else {"track": json.loads(row["track"])})
            length_m, width_m, trials = row["length_m"], row["width_m"], row["trials"]
    played = {
        name: Condition(headway, velocity, max(MEAN_SPEED_MPS, abs(velocity)))
        for name, headway, velocity in map(dict.values, catalogue.ask(CONDITIONS))
    } or {USUAL: HUMAN_CONDITIONS[USUAL]}
    name = USUAL if USUAL in played else ordered(played)[0]
    shown = played[name]
    return {
        "view_box": view_box(track),
        "branches": {side: _path(track, side) for side in SIDES},
        "tunnels": {
            side: [_point(track, side, at) for at in (0.0, track.tunnel_exit_m)] for side in SIDES
        },
        "merge_m": round(track.merge_y_m, 2),
        "vehicles": _vehicles(track, shown),
        "length_m": length_m,
        "width_m": width_m,
        "alone_m": track.merge_point_m - track.tunnel_exit_m,
        "condition": name,
        "words": condition_text(shown.projected_headway_m, shown.relative_velocity_mps),
        "meet": all(abs(one.projected_headway_m) < length_m for one in played.values()),
        "geometries": len(rows),
        "trials": trials,
        "all_trials": sum(row["trials"] for row in rows),
    }


def _vehicles(track: Track, condition: Condition) -> list[dict[str, Any]]:
    """Where both are at constant speeds, a third of the way from the tunnels to the merge."""
    speeds, starts = condition.speeds_mps, condition.starts_m(track)
    merge_s = min(
        (track.merge_point_m - start) / speed for start, speed in zip(starts, speeds, strict=True)
    )
    free_s = max(condition.exit_times_s(track))
    places = condition.positions_m(free_s + (merge_s - free_s) / 3, track)
    vehicles = []
    for side, position_m in zip(SIDES, places, strict=True):
        x, y = _point(track, side, position_m)
        sine, cosine = track.heading(side, position_m)
        matrix = f"{cosine:.4f} {sine:.4f} {-sine:.4f} {cosine:.4f}"
        vehicles.append({"side": side, "x": x, "y": y, "matrix": matrix})
    return vehicles


def _path(track: Track, side: Side) -> str:
    points = [_point(track, side, at) for at in (0.0, track.merge_point_m, track.end_m)]
    return " ".join(f"{x},{y}" for x, y in points)


def _point(track: Track, side: Side, position_m: float) -> tuple[float, float]:
    across, along = track.place(side, position_m)
    return round(along, 2), round(across, 2)
