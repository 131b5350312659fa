"""Pages as Plotly writes them, of trials of our own."""

import base64
import json

import numpy as np

from merge_runner.records import SIDES
from tests.support.recordings import STEP_S, Recording

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
