"""All trials of a condition in one picture."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import pairwise
from math import ceil
from typing import Any

from merge_runner_analysis.explorer.catalogue import Filter
from merge_runner_analysis.explorer.pictures import Axis, Scale
from merge_runner_analysis.explorer.reading import Row
from merge_runner_analysis.explorer.site import NotThere, Site, news_of
from merge_runner_analysis.explorer.traces import MEASURES, Key, read_band, read_traces
from merge_runner_analysis.names import HUMAN

# So many trials are drawn: a browser can still show them, and more would be one dark spot.
MOST = 500
# Sizes in the picture, in its units.
WIDTH, LEFT, RIGHT, PANEL, BETWEEN, TOP, FOOT = 1000, 42, 8, 170, 34, 24, 42
CROSS = "m-5-5 10 10m0-10-10 10"
# What the panels show, by MEASURES.
HEADINGS = (
    "Speed of the vehicle that merged first (m/s)",
    "Speed of the second one (m/s)",
    "Headway: how far the vehicle that merged first is ahead (m)",
)


def condition_page(site: Site, name: str, asked: Mapping[str, str]) -> str:
    """The traces of a condition, of a driver and a prompt if these are asked for.

    Raises NotThere, and NothingNew.
    """
    state = news_of(site.catalogue.state(), asked.get("seen", ""))
    groups = site.catalogue.counts(Filter(condition=name), "model", "variant")
    if not groups:
        raise NotThere(f"no trial of the condition {name} is here")
    wanted = Filter(condition=name, model=asked.get("model", ""), variant=asked.get("variant", ""))
    rows, humans = site.catalogue.every(wanted), Filter(condition=name, model=HUMAN)
    if not wanted.model and any(row["model"] != HUMAN for row in groups):
        rows = [row for row in rows if row["source"] != "human"]
    chosen = [rows[i * len(rows) // MOST] for i in range(MOST)] if len(rows) > MOST else rows
    traces = read_traces(site.db, [_key(row) for row in chosen])
    drawn = {_key(row): row for row in chosen if _key(row) in traces}
    recorded = [_key(row) for row in site.catalogue.every(humans)]
    return site.render(
        "condition.html",
        here="",
        name=name,
        state=state,
        groups=groups,
        chosen={key: value for key, value in wanted.chosen.items() if key != "condition"},
        facets=site.catalogue.facets(wanted),
        sampled=len(rows) if len(rows) > MOST else 0,
        humans=len(recorded),
        drawn=len(drawn),
        picture=picture(drawn, traces, read_band(site.db, recorded)),
    )


def picture(
    drawn: Mapping[Key, Row], traces: Mapping[Key, Row], band: Sequence[Row]
) -> dict[str, Any]:
    """Three panels over one axis of time: where all lines lie, in the units of the picture."""
    ends = [traces[key]["time_s"][-1] for key in drawn]
    end = max([*ends, *(row["time_s"] for row in band)], default=1.0)
    time = Axis(Scale(0.0, end, LEFT, WIDTH - RIGHT), range(ceil(end)))
    axes = {}
    for place, name in enumerate(MEASURES):
        top = TOP + place * (PANEL + BETWEEN)
        alike = MEASURES[2:] if place == len(MEASURES) - 1 else MEASURES[:2]
        lines = (line[one] for one in alike for line in (*map(traces.get, drawn), *band) if line)
        values = [value for line in lines for value in line]
        axes[name] = Axis.of((min(values, default=0.0), max(values, default=0.0)),
                             (top + PANEL, top))  # fmt: skip
    return {
        "width": WIDTH,
        "height": TOP + len(MEASURES) * (PANEL + BETWEEN) - BETWEEN + FOOT,
        "left": LEFT,
        "right": WIDTH - RIGHT,
        "time": time,
        "panels": [
            {"heading": heading, "axis": axes[name],
             "band": _band(name, band, time.scale, axes[name].scale)}
            for name, heading in zip(MEASURES, HEADINGS, strict=True)
        ],
        "lines": [
            {"row": row, "path": _path(row, traces[key], time.scale, axes)}
            for key, row in drawn.items()
        ],
    }  # fmt: skip


def _key(row: Row) -> Key:
    return row["trial_id"], row["spec_hash"]


def _path(row: Row, trace: Row, time: Scale, axes: Mapping[str, Axis]) -> str:
    """One path with a line in each panel; a collision has a cross at its end.

    In whole units, each point by its distance from the one before: that is a third of the text.
    """
    end = CROSS if row["outcome"] == "collided" else ""
    across = time.whole(trace["time_s"])
    steps = [x - before for before, x in pairwise(across)] or [0]
    parts = []
    for name, axis in axes.items():
        up = axis.scale.whole(trace[name])
        rises = [y - before for before, y in pairwise(up)] or [0]
        line = " ".join([f"{x} {y}" for x, y in zip(steps, rises, strict=True)])
        parts.append(f"M{across[0]} {up[0]}l{line}{end}")
    return "".join(parts).replace(" -", "-")


def _band(name: str, band: Sequence[Row], time: Scale, scale: Scale) -> dict[str, str] | None:
    """The humans' median as points of a line, and their 10th to 90th percentile as an area."""
    if not band:
        return None
    low, median, high = (
        [f"{time(row['time_s']):.1f},{scale(row[name][place]):.1f}" for row in band]
        for place in range(3)
    )
    return {"median": " ".join(median), "area": " ".join([*low, *reversed(high)])}
