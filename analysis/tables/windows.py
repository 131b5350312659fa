"""Speed deviation and joint rate over four readings of "the interaction window"."""

from __future__ import annotations

from analysis.data.study import Group, Study, of_group
from analysis.stats.intervals import mean, proportion
from analysis.stats.measures import JOINT, RMSE, published_human
from analysis.tables.model import Column, Row, Table
from analysis.tables.notes import sample_notes

WINDOWS = {
    "first_merge": "to the first merge (ours)",
    "both_merges": "to the second merge",
    "end": "to the end",
    "whole": "with the tunnel",
}


def speed_windows(study: Study) -> Table:
    """One row a group and window; the right window gives the published human values."""
    measured = [group for group in study.groups if group.measured]
    human = " and ".join(
        f"{published_human(m):g} {'%' if m.rate else 'm/s'}" for m in (RMSE, JOINT)
    )
    rows = [_row(study, group, window) for group in measured for window in WINDOWS]
    return Table(
        "speed-windows",
        "Speed deviation and joint rate by the window in which they are taken",
        (
            Column("driver", "driver"),
            Column("setting", "setting"),
            Column("window", "window"),
            Column("n", "n", "count", 0, "finished trials in which the window ends"),
            Column("rmse_mps", "RMSE (m/s)", "number", 2, RMSE.meaning),
            Column("joint_percent", "joint (%)", "percent", 2, JOINT.meaning),
        ),
        rows,
        (
            f"the paper prints {human} for humans; the window that gives both with the imported "
            "recordings is the paper's. Models have no tunnel: their trials start at its exit",
            *([] if rows else ["there is no measured trial to show"]),
            *sample_notes(study, measured),
        ),
    )


def _row(study: Study, group: Group, window: str) -> Row:
    found = study.deviations[study.deviations["time_window"] == window]
    own = of_group(found, group, group.finished)
    rmse = mean(own["rmse_mps"].to_numpy(float))
    joint = proportion(int(own["joint"].sum()), len(own)).value
    return Row(
        f"{group.id}/{window}",
        (group.id,),
        {
            "driver": group.label,
            "setting": group.setting,
            "window": WINDOWS[window],
            "n": rmse.n,
            "rmse_mps": rmse.value,
            "joint_percent": None if joint is None else 100 * joint,
        },
        "" if rmse.n else "no finished trial",
    )
