"""Speed deviation and joint rate under four readings of the paper's "interaction window"."""

from __future__ import annotations

from analysis.data.study import Group, Study, of_group
from analysis.metrics import JOINT, RMSE, Metric
from analysis.stats.intervals import mean, proportion
from analysis.stats.measures import human_reference
from analysis.tables.model import GROUP_COLUMNS, Column, Row, Table, row_of
from analysis.tables.notes import measured_notes

WINDOWS = {
    "first_merge": "to the first merge (ours)",
    "both_merges": "to the second merge",
    "end": "to the end",
    "whole": "with the tunnel",
}


def speed_windows(study: Study) -> Table:
    """A row per group and window; the paper's window is the one that yields its human values."""
    return Table(
        "speed-windows",
        "Speed deviation and joint rate by the window in which they are taken",
        (
            *GROUP_COLUMNS,
            Column("window", "window"),
            Column("n", "n", "count", 0, "finished trials in which the window ends"),
            *(
                Column(one.name, one.heading, one.kind, one.decimals, one.meaning)
                for one in (RMSE, JOINT)
            ),
        ),
        [_row(study, group, window) for group in study.measured for window in WINDOWS],
        (
            f"the paper prints {_printed(RMSE)} and {_printed(JOINT)} for humans; the window that "
            "gives both with the imported "
            "recordings is the paper's. Models have no tunnel: their trials start at its exit",
            *measured_notes(study),
        ),
    )


def _printed(metric: Metric) -> str:
    human = human_reference(metric)
    assert human is not None
    return f"{human.value:g} {metric.unit}"


def _row(study: Study, group: Group, window: str) -> Row:
    found = study.deviations[study.deviations["time_window"] == window]
    own = of_group(found, group, group.finished)
    # The view of the windows names its columns as the metrics' view does, so that the same names
    # select them here.
    rmse = mean(own[RMSE.value].to_numpy(float))
    joint = proportion(int(own[JOINT.value].sum()), len(own)).value
    return row_of(
        group,
        {
            "window": WINDOWS[window],
            "n": rmse.n,
            RMSE.name: rmse.value,
            JOINT.name: None if joint is None else 100 * joint,
        },
        "" if rmse.n else "no finished trial",
        item=window,
    )
