"""All trials of a condition in one picture."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from math import ceil
from typing import Any

from merge_runner_analysis.explorer.catalogue import Filter
from merge_runner_analysis.explorer.pictures import Axis, Scale
from merge_runner_analysis.explorer.reading import Row
from merge_runner_analysis.explorer.site import NotThere, Site, news_of
from merge_runner_analysis.explorer.traces import MEASURES, read_band, read_traces
from merge_runner_analysis.names import HUMAN

# So many trials are drawn: a browser can still show them, and more would be one dark spot.
MOST = 500
# Sizes in the picture, in its units.
WIDTH, LEFT, RIGHT, PANEL, BETWEEN, TOP, FOOT = 1000, 42, 8, 170, 34, 24, 42
CROSS = "m-5-5 10 10m0-10-10 10"


@dataclass(frozen=True, slots=True)
class View:
    """How the vehicles of a trial are told apart: its name, what the first and the second are."""

    name: str
    first: str
    second: str
    meaning: str = ""

    @property
    def headings(self) -> dict[str, str]:
        """What its panels show, by MEASURES."""
        speed, headway = "Speed of {} (m/s)", "Headway: how far {} is ahead (m)"
        texts = (speed.format(self.first), speed.format(self.second), headway.format(self.first))
        return dict(zip(MEASURES, texts, strict=True))


# The first is what a page shows that asks for none: in the other the humans' median is of those
# who go first and of those who yield together, which nobody drives.
VIEWS = {
    "order": View(
        *("who merged first", "the vehicle that merged first", "the second one"),
        "Where nobody merged first it is the vehicle that was ahead at the end.",
    ),
    "side": View("side", "the left vehicle", "the right vehicle"),
}


def condition_page(site: Site, name: str, asked: Mapping[str, str]) -> str:
    """The traces of a condition, of a driver and a prompt if these are asked for.

    Raises NotThere, and NothingNew.
    """
    state = news_of(site.catalogue.state(), asked.get("seen", ""))
    groups = site.catalogue.counts(Filter(condition=name), "model", "variant")
    if not groups:
        raise NotThere(f"no trial of the condition {name} is here")
    usual = next(iter(VIEWS))
    by = asked.get("by") or usual
    if by not in VIEWS:
        raise NotThere(f"vehicles are told apart with by={' or by='.join(VIEWS)}")
    wanted = Filter(condition=name, model=asked.get("model", ""), variant=asked.get("variant", ""))
    chosen = {key: value for key, value in wanted.chosen.items() if key != "condition"}
    alone = all(row["model"] == HUMAN for row in groups)
    rows = _rows(site, wanted, with_humans=alone)
    drawn = [rows[i * len(rows) // MOST] for i in range(MOST)] if len(rows) > MOST else rows
    traces = read_traces(site.db, [_key(row) for row in drawn], by)
    drawn = [row for row in drawn if _key(row) in traces]
    humans = _rows(site, Filter(condition=name, model=HUMAN), with_humans=True)
    band = read_band(site.db, [_key(row) for row in humans], by) if humans else []
    return site.render(
        "condition.html",
        here="",
        name=name,
        by=by,
        view=VIEWS[by],
        choices=[
            (
                view.name,
                site.at.condition(name, by="" if key == usual else key, **chosen),
                key == by,
            )
            for key, view in VIEWS.items()
        ],
        state=state,
        groups=groups,
        chosen=chosen,
        facets=site.catalogue.facets(wanted),
        sampled=len(rows) if len(rows) > MOST else 0,
        humans=len(humans),
        drawn=len(drawn),
        picture=picture(drawn, traces, band, VIEWS[by]),
    )


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
                "heading": heading,
                "axis": axes[name],
                "band": _band(name, band, time.scale, axes[name].scale),
            }
            for name, heading in view.headings.items()
        ],
        "lines": lines,
    }


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
