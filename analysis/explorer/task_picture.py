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
SELECT spec->>'$.track' AS track, length_m, width_m, count(*) AS trials
FROM listed JOIN specs USING (spec_hash) JOIN geometry USING (spec_hash)
WHERE who <> 'humans' GROUP BY ALL ORDER BY trials, track, length_m, width_m
"""
PLAYED = """
SELECT condition, any_value(projected_headway_m) AS headway, any_value(relative_velocity_mps)
    AS velocity FROM listed WHERE who <> 'humans' GROUP BY ALL
"""
# The condition that is shown, if it was played.
USUAL = "L_4_0"


def task_picture(catalogue: Catalogue) -> dict[str, Any]:
    """The geometry of most trials of drivers, in m; as in a replay all drive to the right.

    ``geometries`` is how many there are, ``of`` how many trials have which share in them.
    """
    rows = catalogue.ask(GEOMETRIES)
    track, row = (
        TRACK,
        {
            "length_m": (usual := ScenarioConfig()).vehicle_length_m,
            "width_m": usual.vehicle_width_m,
            "trials": 0,
        },
    )
    for found in rows:
        with suppress(UsageError):  # the audit tells of a spec without a track
            track = track_of(
                {} if found["track"] is None else {"track": json.loads(found["track"])}
            )
            row = found
    played = {one["condition"]: (one["headway"], one["velocity"]) for one in catalogue.ask(PLAYED)}
    name = USUAL if USUAL in played or not played else ordered(played)[0]
    usual_one = HUMAN_CONDITIONS[USUAL]
    headway, velocity = played.get(
        name, (usual_one.projected_headway_m, usual_one.relative_velocity_mps)
    )
    return {
        "view_box": view_box(track),
        "branches": {side: _path(track, side) for side in SIDES},
        "tunnels": {
            side: [_point(track, side, at) for at in (0.0, track.tunnel_exit_m)] for side in SIDES
        },
        "merge_m": round(track.merge_y_m, 2),
        "vehicles": _vehicles(track, headway, velocity),
        "length_m": row["length_m"],
        "width_m": row["width_m"],
        "alone_m": track.merge_point_m - track.tunnel_exit_m,
        "condition": name,
        "words": condition_text(headway, velocity),
        "meet": all(abs(headway) < row["length_m"] for headway, _ in played.values()),
        "geometries": len(rows),
        "trials": row["trials"],
        "all_trials": sum(one["trials"] for one in rows),
    }


def _vehicles(track: Track, headway_m: float, velocity_mps: float) -> list[dict[str, Any]]:
    """Where both are at constant speeds, a third of the way from the tunnels to the merge."""
    condition = Condition(headway_m, velocity_mps, max(MEAN_SPEED_MPS, abs(velocity_mps)))
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
