"""All trials of a condition in one picture, and the list of the conditions."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from math import ceil
from typing import Any

from analysis.explorer.catalogue import Filter
from analysis.explorer.conditions import ordered
from analysis.explorer.pictures import Axis, Scale
from analysis.explorer.reading import Row
from analysis.explorer.site import NothingNew, NotThere, Site
from analysis.explorer.traces import MEASURES, read_band, read_traces

HUMAN = "human"
# So many trials are drawn: a browser can still show them, and more would be one dark spot.
MOST = 500
# Sizes in the picture, in its units.
WIDTH, LEFT, RIGHT, PANEL, BETWEEN, TOP, FOOT = 1000, 42, 8, 170, 34, 24, 42
CROSS = "m-5-5 10 10m0-10-10 10"
COUNTED = """
SELECT {columns}, count(*) AS trials, count(*) FILTER (outcome = 'left first') AS left_first,
    count(*) FILTER (outcome = 'right first') AS right_first,
    count(*) FILTER (outcome = 'collided') AS collided, avg(gap_m) AS gap_m
FROM listed WHERE {where} GROUP BY ALL ORDER BY ALL
"""


# What joins the names of two different drivers.
MIXED = "contains(model, '+')"


@dataclass(frozen=True, slots=True)
class View:
    """By what the vehicles of a trial are told apart: its name, its panels, and who goes first.

    The panels show MEASURES; ``outcomes`` are in words that the first vehicle, or the second one,
    went first.
    """

    name: str
    panels: tuple[str, str, str]
    outcomes: tuple[str, str]
    meaning: str = ""


SIDES_APART = ("left first", "right first")
# The humans' median is that of one way of driving only by order: elsewhere those who go first and
# those who yield are in one.
ORDER = "order"
VIEWS = {
    "": View(
        "who merged first",
        (
            "Speed of the vehicle that merged first",
            "Speed of the second one",
            "Headway: how far the first one is ahead",
        ),
        SIDES_APART,
        "Where nobody merged first it is the vehicle that was ahead at the end.",
    ),
    "side": View(
        "side",
        (
            "Speed of the left vehicle",
            "Speed of the right vehicle",
            "Headway: how far the left vehicle is ahead",
        ),
        SIDES_APART,
    ),
    "driver": View(
        "who drives",
        (
            "Speed of the driver that is named first",
            "Speed of the other driver",
            "Headway: how far the driver named first is ahead",
        ),
        ("the driver named first went first", "the other one did"),
        "Shown are pairs of two different drivers; of the humans, the vehicles on the same sides.",
    ),
}
# By driver a line has the look of who went first: the driver that is named first, or the other one.
TURNED_KIND = {"left-first": "right-first", "right-first": "left-first"}
UNITS = dict(zip(MEASURES, ("m/s", "m/s", "m"), strict=True))


def conditions_page(site: Site, asked: Mapping[str, str]) -> str:
    """All conditions that trials were played in; raises NothingNew."""
    state = _news(site, asked)
    found = {
        (row["condition"], row["model"]): row
        for row in _counted(site, "condition, model", Filter())
    }
    names = ordered({name for name, _ in found})
    return site.render(
        "conditions.html",
        here="conditions",
        cells=found,
        names=names,
        drivers=sorted({model for _, model in found}, key=lambda model: (model == HUMAN, model)),
        state=state,
    )


def condition_page(site: Site, name: str, asked: Mapping[str, str]) -> str:
    """The traces of a condition, of a driver and a prompt if these are asked for.

    Raises NotThere, and NothingNew.
    """
    state = _news(site, asked)
    groups = _counted(site, "model, variant", Filter(condition=name))
    if not groups:
        raise NotThere(f"no trial of the condition {name} is here")
    by, views = asked.get("by", ""), views_of(site, name)
    if by not in views:
        raise NotThere(f"vehicles are told apart by order, or with by={' or by='.join(views[1:])}")
    wanted = Filter(condition=name, model=asked.get("model", ""), variant=asked.get("variant", ""))
    chosen = {key: value for key, value in wanted.chosen.items() if key != "condition"}
    alone = all(row["model"] == HUMAN for row in groups)
    rows = _rows(site, wanted, with_humans=site.static or alone, mixed=by == "driver")
    drawn = [rows[i * len(rows) // MOST] for i in range(MOST)] if len(rows) > MOST else rows
    traces = read_traces(site.db, [_key(row) for row in drawn], by or ORDER)
    drawn = [row for row in drawn if _key(row) in traces]
    humans = _rows(site, Filter(condition=name, model=HUMAN), with_humans=True)
    return site.render(
        "condition.html",
        here="conditions",
        name=name,
        by=by,
        view=VIEWS[by],
        choices=[
            (VIEWS[key].name, site.at.condition(name, by=key, **chosen), key == by) for key in views
        ],
        state=state,
        groups=groups,
        chosen=chosen,
        facets=site.catalogue.facets(wanted),
        sampled=len(rows) if len(rows) > MOST else 0,
        humans=len(humans),
        drawn=len(drawn),
        picture=picture(drawn, traces, _band_of(site, humans, by, traces), VIEWS[by]),
    )


def views_of(site: Site, condition: str) -> list[str]:
    """The views of a condition: by driver where two different ones drove."""
    found = site.catalogue.ask(
        f"SELECT 1 FROM listed WHERE condition = ? AND {MIXED} LIMIT 1",  # noqa: S608 # constant
        condition,
    )
    return [key for key in VIEWS if found or key != "driver"]


def _band_of(site: Site, humans: Sequence[Row], by: str, traces: Mapping[Any, Row]) -> list[Row]:
    """Where the humans' traces lie, in the same view: by driver, those on the drivers' sides."""
    if not humans:
        return []
    keys = [_key(row) for row in humans]
    if by == "driver":
        return read_band(site.db, keys, seats={trace["turned"] for trace in traces.values()})
    return read_band(site.db, keys, by or ORDER)


def picture(
    drawn: Sequence[Row], traces: Mapping[Any, Row], band: Sequence[Row], view: View
) -> dict[str, Any]:
    """Three panels over one axis of time: where all lines lie, in the units of the picture."""
    ends = [traces[_key(row)]["time_s"][-1] for row in drawn]
    end = max([*ends, *(row["time_s"] for row in band)], default=1.0)
    time = Axis(Scale(0.0, end, LEFT, WIDTH - RIGHT), range(ceil(end)))
    lines_of = [*(traces[_key(row)] for row in drawn), *band]
    values = {name: [value for line in lines_of for value in line[name]] for name in MEASURES}
    speeds = [*values["first_mps"], *values["second_mps"]]
    axes = {}
    for place, name in enumerate(MEASURES):
        top = TOP + place * (PANEL + BETWEEN)
        shown = values[name] if name == "headway_m" else speeds  # both speeds can be compared
        axes[name] = Axis.of((min(shown, default=0.0), max(shown, default=0.0)), (top + PANEL, top))
    lines: dict[tuple[str, str], list[dict[str, Any]]] = {}
    for row in drawn:
        trace = traces[_key(row)]
        kind = str(row["outcome"]).replace(" ", "-")
        if view is VIEWS["driver"] and trace["turned"]:
            kind = TURNED_KIND.get(kind, kind)
        of = lines.setdefault((row["model"], row["variant"] or ""), [])
        of.append({"row": row, "kind": kind, "path": _path(row, trace, time.scale, axes)})
    return {
        "width": WIDTH,
        "height": TOP + len(MEASURES) * (PANEL + BETWEEN) - BETWEEN + FOOT,
        "left": LEFT,
        "right": WIDTH - RIGHT,
        "time": time,
        "panels": [
            {
                "heading": f"{heading} ({UNITS[name]})",
                "axis": axes[name],
                "band": _band(name, band, time.scale, axes[name].scale),
            }
            for name, heading in zip(MEASURES, view.panels, strict=True)
        ],
        "lines": lines,
    }


def _news(site: Site, asked: Mapping[str, str]) -> str:
    """What is listed now, as a text; raises NothingNew where that was ``seen``."""
    state = "-".join(map(str, site.catalogue.state()))
    if asked.get("seen") == state:
        raise NothingNew
    return state


def _counted(site: Site, columns: str, wanted: Filter) -> list[Row]:
    where, values = wanted.where()
    return site.catalogue.ask(COUNTED.format(columns=columns, where=where), *values)


def _rows(site: Site, wanted: Filter, *, with_humans: bool, mixed: bool = False) -> list[Row]:
    """The trials of a filter, the mixed ones alone or all; humans if they alone are wanted."""
    where, values = wanted.where()
    others = "" if with_humans or wanted.model else " AND source <> 'human'"
    others += f" AND {MIXED}" if mixed else ""
    return site.catalogue.ask(
        "SELECT trial_id, spec_hash, condition, model, variant, outcome, end_time_s "  # noqa: S608 # constants
        f"FROM listed WHERE {where}{others} ORDER BY trial_id, spec_hash",
        *values,
    )


def _key(row: Row) -> tuple[str, str]:
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
