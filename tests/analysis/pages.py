"""Pages as Plotly writes them, of trials and pedals of our own."""

from __future__ import annotations

import base64
import json

import numpy as np

from merge_runner.records import SIDES
from merge_runner.scenarios.merge.conditions import HUMAN_CONDITIONS
from merge_runner.scenarios.merge.vehicle import net_acceleration
from tests.analysis.recordings import STEP_S, Recording

DASHES = {"first": "solid", "second": "dash", "Collided": "dot"}


def page(traces: list[dict]) -> bytes:
    """A page with the traces of a plot, behind words that look like another one."""
    text = json.dumps(traces, separators=(",", ":"))
    return (
        '<html>\n<head><meta charset="utf-8" /></head>\n<body>\n    <div>'
        "<script>/* plotly.js */ function draw(){ Plotly.newPlot(1, [{}]) }</script>"
        '<div id="a-b"></div><script>window.PLOTLYENV=window.PLOTLYENV || {};'
        'if (document.getElementById("a-b")) { Plotly.newPlot(                        "a-b", '
        f'                       {text},                        {{"template":{{"data":[]}}}}, '
        '                       {"responsive": true}                    ) };</script></div>'
        "\n</body></html>"
    ).encode()


def packed(values) -> dict:
    """An array as newer versions of Plotly write it."""
    content = np.asarray(values, dtype="<f8").tobytes()
    return {"dtype": "f8", "bdata": base64.b64encode(content).decode()}


def velocity_page(trials: dict[str, Recording], form=list) -> bytes:
    """The velocity page of trials of one condition, by ``pair-iteration``."""
    traces = []
    for label, recording in trials.items():
        columns = recording.columns
        ends = {side: columns[f"travelled_distance.{side}"][-1] for side in SIDES}
        for side in SIDES:
            speeds = columns[f"velocities.{side}"]
            place = "first" if ends[side] == max(ends.values()) else "second"
            end = columns["end_state"][0]
            panel = "2" if side == "right" else ""
            traces.append(
                {
                    "hovertemplate": label,
                    "legendgroup": label[0],
                    "line": {"color": "#1F77B4", "dash": DASHES.get(end, DASHES[place])},
                    "mode": "lines",
                    "name": label[0],
                    "x": form([k * STEP_S for k in range(len(speeds))]),
                    "y": form(speeds),
                    "type": "scatter",
                    "xaxis": f"x{panel}",
                    "yaxis": f"y{panel}",
                }
            )
    legend = [
        {"name": name, "x": form([0]), "y": form([0]), "line": {"dash": dash}, "type": "scatter"}
        for name, dash in (("Went First", "solid"), ("Went Second", "dash"), ("Collision", "dot"))
    ]
    return page([*traces, *legend])


def first_action(pedal: float, nominal_mps: float) -> float:
    """What the recorder writes of the first step under control at this pedal, by simulation."""
    speed = nominal_mps
    for _ in range(2_000):  # the cruise control settles
        held = 2.5 * min(max(5.0 * (nominal_mps - speed), -1.0), 1.0)
        speed += 0.05 * net_acceleration(held, speed, "human")
    after = speed + 0.05 * net_acceleration(2.5 * pedal, speed, "human")
    return net_acceleration(2.5 * pedal, after, "human")


def first_actions(count: int, seed: int = 1) -> list[tuple[float, str | None, float, float]]:
    """Relative velocity, who merged first, left and right action of simulated pedals."""
    rng = np.random.default_rng(seed)
    steps = rng.integers(-126, 129, (count, 2))
    pedals = 0.5 + steps / np.where(steps >= 0, 256, 252)
    relative = np.resize([c.relative_velocity_mps for c in HUMAN_CONDITIONS.values()], count)
    first = np.resize(["left", "right", "right", None], count)
    return [
        (
            float(velocity),
            who,
            float(first_action(left, 10 + velocity / 2)),
            float(first_action(right, 10 - velocity / 2)),
        )
        for velocity, who, (left, right) in zip(relative, first, pedals, strict=True)
    ]


def first_action_page(trials, form=list) -> bytes:
    """The scatter plot of these trials, one trace an outcome, and its diagonal."""
    traces = []
    for name, who in (("right", "right"), ("left", "left"), ("Collision", None)):
        mine = [one for one in trials if one[1] == who]
        traces.append(
            {
                "hovertemplate": f"who went first={name}<br>left=%{{x}}<extra></extra>",
                "name": name,
                "mode": "markers",
                "x": form([one[2] for one in mine]),
                "y": form([one[3] for one in mine]),
                "type": "scattergl",
            }
        )
    diagonal = {"mode": "lines", "x": form([-4, 4]), "y": form([-4, 4]), "type": "scatter"}
    return page([*traces, diagonal])
