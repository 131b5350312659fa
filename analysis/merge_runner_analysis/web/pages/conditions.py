"""All trials of a condition in one picture: speeds and headway over time, beside the humans'."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from itertools import pairwise
from math import ceil, floor
from typing import Any

from merge_runner_analysis.web.reading import Row
from merge_runner_analysis.web.scope import carried, scope_of
from merge_runner_analysis.web.site import NotThere, Site, news_of

# Drawn trials: a browser can still show them, and more would be one dark spot.
MOST = 500
# Sizes in the picture, in its units.
WIDTH, LEFT, RIGHT, PANEL, BETWEEN, TOP, FOOT = 1000, 42, 8, 170, 34, 24, 42
KEY = "trial_id", "spec_hash"
Scale = Callable[[float], float]
"""Place of a value in the picture."""
CROSS = "m-5-5 10 10m0-10-10 10"
# The drawn series of a trial, each a list; the headway belongs to the vehicle that went first.
PANELS = {
    "first_mps": "Speed of the vehicle that merged first (m/s)",
    "second_mps": "Speed of the second one (m/s)",
    "headway_m": "How far the first is ahead (m)",
}
# Both vehicles of the trials $1 with the specs $2 at the sample under control that is nearest to
# every 0.2 s, which is the step of most drivers, and at the last one. Where nobody merged first,
# the first is who was ahead at the end.
SAMPLED = """
WITH wanted AS (
    SELECT unnest($1::VARCHAR[]) AS trial_id, unnest($2::VARCHAR[]) AS spec_hash
), ordered AS (
    SELECT trial_id, spec_hash, coalesce(any_value(merged_first) = 'right',
        arg_max(position_m, step) FILTER (side = 'left')
            < arg_max(position_m, step) FILTER (side = 'right')) AS turned
    FROM states JOIN trials USING (trial_id, spec_hash) SEMI JOIN wanted USING (trial_id, spec_hash)
    GROUP BY ALL
), sampled AS (
    SELECT trial_id, spec_hash, step, any_value(time_s) AS time_s,
        any_value(velocity_mps) FILTER ((side = 'right') = turned) AS first_mps,
        any_value(velocity_mps) FILTER ((side = 'left') = turned) AS second_mps,
        any_value(position_m) FILTER ((side = 'right') = turned)
            - any_value(position_m) FILTER ((side = 'left') = turned) AS headway_m
    FROM states JOIN ordered USING (trial_id, spec_hash)
    WHERE time_s >= 0 GROUP BY ALL HAVING headway_m IS NOT NULL
), nearest AS (
    SELECT *, round(5 * time_s)::INTEGER AS place, 1 = row_number() OVER (
        PARTITION BY trial_id, spec_hash, place ORDER BY abs(5 * time_s - place), step) AS is_near
    FROM sampled
    QUALIFY is_near OR step = max(step) OVER (PARTITION BY trial_id, spec_hash)
)
"""
TRACES = f"""
{SAMPLED}
SELECT trial_id, spec_hash, list(time_s ORDER BY step) AS time_s, {
    ", ".join(f"list({name} ORDER BY step) AS {name}" for name in PANELS)
}
FROM nearest GROUP BY ALL
"""  # noqa: S608 # constants
# The 10th, 50th and 90th percentile. Where fewer than half of the trials go on, the rest are no
# picture of all.
BAND = f"""
{SAMPLED}
SELECT place / 5 AS time_s, {
    ", ".join(f"quantile_cont({name}, [0.1, 0.5, 0.9]) AS {name}" for name in PANELS)
}
FROM nearest WHERE is_near GROUP BY place
HAVING 2 * count(*) >= (SELECT count(*) FROM nearest WHERE is_near AND place = 0) ORDER BY place
"""  # noqa: S608 # constants


def condition_page(site: Site, name: str, params: Mapping[str, str]) -> str:
    """Return the traces of a condition, within the scope of the address.

    Raises NotThere, and NothingNew as they were ``seen``.
    """
    state = news_of(site.trial_index.state, params.get("seen", ""))
    if not site.trial_index.in_words(name):
        raise NotThere(f"there is no condition {name!r} here")
    bar = scope_of(site, params, any_prompt=True)
    filters = {**bar.scope.filters, "condition": name, "who": ["drivers", "mocks"]}
    rows = site.trial_index.every(filters)
    humans = site.trial_index.every({"condition": name, "who": "humans"})
    chosen = [rows[i * len(rows) // MOST] for i in range(MOST)] if len(rows) > MOST else rows
    traces = {(row["trial_id"], row["spec_hash"]): row for row in _read(site, TRACES, chosen)}
    drawn = [
        row | trace for row in chosen if (trace := traces.get((row["trial_id"], row["spec_hash"])))
    ]
    band = _read(site, BAND, humans)
    return site.render(
        "condition.html",
        view="",
        name=name,
        bar=bar,
        carried={key: kept for key, kept in carried(params).items() if key != "condition"},
        sweep=bar.scope.sweep,
        state=state,
        groups=site.trial_index.counts(filters, "model", "variant"),
        trials=len(rows),
        drawn=len(drawn),
        sampled=len(rows) > MOST,
        humans=len(humans),
        picture=picture(drawn, band) if drawn or band else None,
    )


def picture(drawn: Sequence[Row], band: Sequence[Row]) -> dict[str, Any]:
    """Return three panels over one axis of time, with their lines in the picture's units."""
    end = max([*(row["time_s"][-1] for row in drawn), *(row["time_s"] for row in band)])
    time, seconds = _axis([0.0, end], (LEFT, WIDTH - RIGHT), most=16)
    values = {name: [v for row in [*drawn, *band] for v in row[name]] for name in PANELS}
    speeds = values["first_mps"] + values["second_mps"]
    panels, scales = [], {}
    for place, (name, heading) in enumerate(PANELS.items()):
        top = TOP + place * (PANEL + BETWEEN)
        shown = values[name] if name == "headway_m" else speeds  # both speeds can be compared
        scales[name], ticks = _axis(shown, (top + PANEL, top), most=6)
        low, median, high = (
            [f"{time(row['time_s']):.1f},{scales[name](row[name][i]):.1f}" for row in band]
            for i in range(3)
        )
        area, middle = " ".join([*low, *reversed(high)]), " ".join(median)
        panels.append(
            {"heading": heading, "top": top, "ticks": ticks, "area": area, "median": middle}
        )
    return {
        "width": WIDTH,
        "height": TOP + len(PANELS) * (PANEL + BETWEEN) - BETWEEN + FOOT,
        "left": LEFT,
        "right": WIDTH - RIGHT,
        "panel": PANEL,
        "seconds": seconds,
        "panels": panels,
        "lines": [(row, _path(row, time, scales)) for row in drawn],
    }


def _axis(
    values: Sequence[float], places: tuple[float, float], most: int
) -> tuple[Scale, list[tuple[float, int]]]:
    """Return an axis of whole steps that holds all values, and its ticks: (place, value)."""
    low, high = min(values), max(values)
    steps = (size * 10**zeros for zeros in range(9) for size in (1, 2, 5))
    step: int = next(step for step in steps if high - low <= (most - 1) * step)
    first, last = floor(low / step), max(ceil(high / step), floor(low / step) + 1)
    begin, end = places

    def scale(value: float) -> float:
        return begin + (end - begin) * (value / step - first) / (last - first)

    return scale, [(round(scale(i * step), 1), i * step) for i in range(first, last + 1)]


def _path(row: Row, time: Scale, scales: Mapping[str, Scale]) -> str:
    """Return a path with a line in each panel; a collision has a cross at its end.

    In whole units, each point by its distance from the one before: that is a third of the text.
    """
    end = CROSS if row["outcome"] == "collided" else ""
    across = [round(time(t)) for t in row["time_s"]]
    parts = []
    for name, scale in scales.items():
        points = list(zip(across, [round(scale(v)) for v in row[name]], strict=True))
        line = " ".join([f"{x - x0} {y - y0}" for (x0, y0), (x, y) in pairwise(points)])
        parts.append(f"M{points[0][0]} {points[0][1]}l{line or '0 0'}{end}")
    return "".join(parts)


def _read(site: Site, sql: str, trials: Sequence[Row]) -> list[Row]:
    return site.trial_index.ask(sql, *([row[name] for row in trials] for name in KEY))
