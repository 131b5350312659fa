"""Files as the experiment's recorder writes them, of trials driven by simple drivers."""

import csv
import io
import zipfile
from dataclasses import dataclass, field
from pathlib import Path

from merge_runner.records import SIDES
from merge_runner.scenarios.merge.conditions import CONDITIONS
from merge_runner.scenarios.merge.geometry import TRACK
from merge_runner.scenarios.merge.vehicle import advance
from merge_runner_analysis.humans.archive import File

STEP_S = 0.05
HEADER = (
    *("dt", "max_time", "simulation_constants.dt", "simulation_constants.vehicle_width"),
    *("simulation_constants.vehicle_length", "simulation_constants.track_start_point_distance"),
    *("simulation_constants.track_section_length", "simulation_constants.max_time"),
    *("vehicle_width", "vehicle_length", "agent_types.left", "agent_types.right", "end_state"),
    *("positions.left", "positions.right", "travelled_distance.left", "travelled_distance.right"),
    *("raw_input.left", "raw_input.right", "velocities.left", "velocities.right"),
    *("accelerations.left", "accelerations.right"),
    *("net_accelerations.left", "net_accelerations.right", "current_condition"),
)
AGENT = "<class 'agents.steeringwheelagent.SteeringWheelAgent'>"


@dataclass
class Recording:
    """One trial: a list for each column, with one value for a scalar."""

    columns: dict[str, list] = field(default_factory=dict)

    def csv(self) -> bytes:
        text = io.StringIO()
        writer = csv.writer(text)
        writer.writerow(self.columns)
        longest = max(map(len, self.columns.values()))
        padded = [values + [""] * (longest - len(values)) for values in self.columns.values()]
        writer.writerows(zip(*padded, strict=True))
        return text.getvalue().encode()


def drive(
    condition="L_4_0", *, yields="right", late=False, slowest_mps=6.0, starts_m=0.0
) -> Recording:
    """A trial in which one side yields, ``both`` do until they stand, or ``nobody`` does.

    Who yields slows down to ``slowest_mps``, ``starts_m`` after both are in sight. ``late``
    leaves out the first sample, as the recorder of simulated drivers does.
    """
    start = CONDITIONS[condition]
    positions, speeds = [list(start.starts_m(TRACK))], [list(start.speeds_mps)]
    inputs = [[0.0, 0.0]]
    end_state = None
    while end_state is None:
        s, v = positions[-1], speeds[-1]
        free = min(s) > 50 + starts_m
        net = [0.0, 0.0]
        for i, side in enumerate(SIDES):
            gives_way = free and yields in (side, "both")
            slowest = slowest_mps if yields == side else 0.0
            wanted = slowest if gives_way else start.speeds_mps[i] - 0.08
            net[i] = min(max(wanted - v[i], -2.0), 1.0)
        moved = [advance(s[i], v[i], net[i], STEP_S) for i in (0, 1)]
        positions.append([m[0] for m in moved])
        speeds.append([m[1] for m in moved])
        inputs.append([(net[i] + 0.005 * v[i] ** 2 + 0.5) / 2.5 for i in (0, 1)])
        end_state = _end(positions)
    first = 1 if late else 0
    return _recording(positions[first:], speeds[first:], inputs[first:], end_state)


def _end(positions) -> str | None:
    left, right = positions[-1]
    if min(left, right) > 93 and abs(left - right) < 4.5:
        return "Collided"
    if max(left, right) >= 150:
        return "Finished"
    return "Time ran out" if len(positions) == 601 else None


def _recording(positions, speeds, inputs, end_state) -> Recording:
    scalars = {
        **dict.fromkeys(("dt", "simulation_constants.dt"), 50),
        **dict.fromkeys(("max_time", "simulation_constants.max_time"), 30000.0),
        **dict.fromkeys(("vehicle_width", "simulation_constants.vehicle_width"), 1.8),
        **dict.fromkeys(("vehicle_length", "simulation_constants.vehicle_length"), 4.5),
        "simulation_constants.track_start_point_distance": 25.0,
        "simulation_constants.track_section_length": 50.0,
        **dict.fromkeys(("agent_types.left", "agent_types.right"), AGENT),
        "end_state": end_state,
        "current_condition": "<experiment.conditiondefinition.ConditionDefinition object at "
        "0x7f6b2fdb0350>",
    }
    columns = {name: [value] for name, value in scalars.items()}
    for i, side in enumerate(SIDES):
        columns[f"positions.{side}"] = [list(TRACK.place(side, s[i])) for s in positions]
        columns[f"travelled_distance.{side}"] = [s[i] for s in positions]
        columns[f"velocities.{side}"] = [v[i] for v in speeds]
        columns[f"raw_input.{side}"] = [u[i] for u in inputs]
        columns[f"accelerations.{side}"] = [2.5 * u[i] for u in inputs]
        columns[f"net_accelerations.{side}"] = [
            2.5 * u[i] - 0.005 * v[i] ** 2 - 0.5 for u, v in zip(inputs, speeds, strict=True)
        ]
    return Recording({name: columns[name] for name in HEADER})


def file(name: str, content: bytes) -> File:
    """A file of a download, held in memory."""
    return File(name, len(content), lambda: content)


def write_folder(folder: Path, files: dict[str, bytes]) -> Path:
    """Write files by their path within the folder."""
    for name, content in files.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(content)
    return folder


def write_zip(path: Path, files: dict[str, bytes], compression=zipfile.ZIP_DEFLATED) -> Path:
    """Pack files into a zip, under the very names given."""
    with zipfile.ZipFile(path, "w", compression) as archive:
        for name, content in files.items():
            archive.writestr(zipfile.ZipInfo(name), content, compression)
    return path
