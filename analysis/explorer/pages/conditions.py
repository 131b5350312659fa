"""All trials of a condition in one picture, and the list of the conditions."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import Any

from analysis.explorer.catalogue import Filter
from analysis.explorer.conditions import condition_texts, ordered
from analysis.explorer.pictures import Axis, Scale, ends_and_ticks
from analysis.explorer.reading import Row
from analysis.explorer.site import NothingNew, NotThere, Site
from analysis.explorer.traces import MEASURES, read_band, read_traces

HUMAN = "human"
# So many trials are drawn: a browser can still show them, and more would be one dark spot.
MOST = 500
# Sizes in the picture, in its units.
WIDTH, LEFT, RIGHT, PANEL, BETWEEN, TOP, FOOT = 1000, 42, 8, 170, 34, 24, 42
PANELS = dict(
    zip(
        MEASURES,
        (
            ("Speed of the left vehicle", "m/s"),
            ("Speed of the right vehicle", "m/s"),
            ("Headway: how far the left vehicle is ahead", "m"),
        ),
        strict=True,
    )
)
CROSS = "m-5-5 10 10m0-10-10 10"
COUNTED = """
SELECT {columns}, count(*) AS trials, count(*) FILTER (outcome = 'left first') AS left_first,
    count(*) FILTER (outcome = 'right first') AS right_first,
    count(*) FILTER (outcome = 'collided') AS collided, avg(gap_m) AS gap_m
FROM listed WHERE {where} GROUP BY ALL ORDER BY ALL
"""


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
        condition_texts=condition_texts(site.catalogue, names),
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
    wanted = Filter(condition=name, model=asked.get("model", ""), variant=asked.get("variant", ""))
    drivers = [row for row in groups if row["model"] != HUMAN]
    rows = _rows(site, wanted, with_humans=site.static or not drivers)
    drawn = [rows[i * len(rows) // MOST] for i in range(MOST)] if len(rows) > MOST else rows
    traces = read_traces(site.db, [_key(row) for row in drawn])
    humans = _rows(site, Filter(condition=name, model=HUMAN), with_humans=True)
    band = read_band(site.db, [_key(row) for row in humans]) if humans else []
    drawn = [row for row in drawn if _key(row) in traces]
    facets = site.catalogue.facets(wanted)
    return site.render(
        "condition.html",
        here="conditions",
        name=name,
        text=condition_texts(site.catalogue, [name])[name],
        state=state,
        groups=groups,
        chosen={key: value for key, value in wanted.chosen.items() if key != "condition"},
        facets={key: facets[key] for key in ("model", "variant")},
        sampled=len(rows) if len(rows) > MOST else 0,
        humans=len(humans),
        drawn=len(drawn),
        picture=picture(drawn, traces, band),
    )


def picture(drawn: Sequence[Row], traces: Mapping[Any, Row], band: Sequence[Row]) -> dict[str, Any]:
    """Three panels over one axis of time: where all lines lie, in the units of the picture."""
    ends = [traces[_key(row)]["time_s"][-1] for row in drawn]
    time = _axis([0.0, *ends, *(row["time_s"] for row in band)], LEFT, WIDTH - RIGHT)
    lines_of = [*(traces[_key(row)] for row in drawn), *band]
    values = {name: [value for line in lines_of for value in line[name]] for name in MEASURES}
    speeds = [*values["left_mps"], *values["right_mps"]]
    axes = {}
    for place, name in enumerate(MEASURES):
        top = TOP + place * (PANEL + BETWEEN)
        shown = values[name] if name == "headway_m" else speeds  # both speeds can be compared
        axes[name] = _axis(shown or [0.0], top + PANEL, top)
    lines: dict[tuple[str, str], list[dict[str, Any]]] = {}
    for row in drawn:
        of = lines.setdefault((row["model"], row["variant"] or ""), [])
        of.append({"row": row, "path": _path(row, traces[_key(row)], time.scale, axes)})
    return {
        "width": WIDTH,
        "height": TOP + len(MEASURES) * (PANEL + BETWEEN) - BETWEEN + FOOT,
        "left": LEFT,
        "right": WIDTH - RIGHT,
        "seconds": [(time.y(tick), f"{tick:g}") for tick in time.ticks],
        "panels": [
            {
                "heading": heading,
                "unit": unit,
                "top": axes[name].y(axes[name].scale.high),
                "bottom": axes[name].y(axes[name].scale.low),
                "ticks": [(axes[name].y(tick), f"{tick:g}") for tick in axes[name].ticks],
                "band": _band(name, band, time.scale, axes[name].scale),
            }
            for name, (heading, unit) in PANELS.items()
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


def _rows(site: Site, wanted: Filter, *, with_humans: bool) -> list[Row]:
    """The trials of a filter; humans are among them if they alone are wanted."""
    where, values = wanted.where()
    others = "" if with_humans or wanted.model else " AND source <> 'human'"
    return site.catalogue.ask(
        "SELECT trial_id, spec_hash, condition, model, variant, outcome, end_time_s "  # noqa: S608 # constants
        f"FROM listed WHERE {where}{others} ORDER BY trial_id, spec_hash",
        *values,
    )


def _key(row: Row) -> tuple[str, str]:
    return row["trial_id"], row["spec_hash"]


def _axis(values: Sequence[float], from_: float, to: float) -> Axis:
    """An axis that ends where the values do, and its ticks between."""
    low, high = min(values), max(values)
    first, last, ticks = ends_and_ticks(low, high, low, high)
    low, high = (low, high) if low < high else (first, last)
    return Axis(Scale(low, high, from_, to), [tick for tick in ticks if low <= tick <= high])


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
