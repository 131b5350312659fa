"""Drivers: all of them in a list, and a page for each, beside the humans and perhaps another."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any

from merge_runner.records import SIDES
from merge_runner_analysis.published import HUMAN
from merge_runner_analysis.tables.formats import printed
from merge_runner_analysis.tables.model import Row as TableRow
from merge_runner_analysis.web.comparison import compared
from merge_runner_analysis.web.computing import Job
from merge_runner_analysis.web.display_text import with_minus
from merge_runner_analysis.web.judged import by_condition, by_kind, humans_of, judged, noted
from merge_runner_analysis.web.marks import rate
from merge_runner_analysis.web.people import counted
from merge_runner_analysis.web.scope import Scope, scope_of, unmarked
from merge_runner_analysis.web.search import search
from merge_runner_analysis.web.site import NotThere, Site
from merge_runner_analysis.wording import MEASURES

# Outcomes and served models of the attempts of a driver's trials with a prompt.
ATTEMPTS = """
SELECT model_served AS served, scripted, outcome, count(*) AS times
FROM calls SEMI JOIN (FROM listed WHERE model = ? AND variant = ?) USING (trial_id, spec_hash)
GROUP BY ALL ORDER BY ALL
"""


def drivers_page(site: Site, params: Mapping[str, str]) -> str:
    """Return all drivers with their prompts; raises NotThere."""
    bar = scope_of(site, params)
    chosen = bar.scope.drivers or bar.drivers
    drivers, values = judged(site, bar, params)
    kinds = by_kind([driver for driver in drivers if unmarked(driver.name) in chosen])
    trials_counted = partial(counted, conditions=by_condition(site, bar.scope, drivers))
    return site.render(
        "drivers.html",
        view="drivers",
        kinds=kinds,
        trials_counted=trials_counted,
        notes=noted(
            [driver for of_kind in kinds.values() for driver in of_kind],
            {name: measure.label for name, measure in MEASURES.items() if _is_shown(site, name)},
        ),
        **values,
    )


def _is_shown(site: Site, measure: str) -> bool:
    """Return whether the list has a column for a measure: I5 needs imported recordings."""
    return measure != "held" or site.trial_index.has_humans


def driver_page(site: Site, name: str, params: Mapping[str, str]) -> str:
    """Return the page of a driver with one prompt, or of ``human``; raises NotThere."""
    if name == HUMAN:  # whose published numbers are of all situations
        params = {key: value for key, value in params.items() if key != "condition"}
    bar = scope_of(site, params, "" if name == HUMAN else name)
    scope = bar.scope
    drivers, values = judged(site, bar, params)
    by_name = {driver.name: driver for driver in drivers if driver.prompt == scope.prompt}
    driver = by_name.get(name)
    if driver is None and name != HUMAN and values["table"] is not None:
        raise NotThere(
            f"no driver {name!r} was played with this prompt; there are: "
            f"{', '.join(by_name) or 'none'}"
        )
    trials = scope.trials(name, scope.prompt)
    other_driver = by_name.get(params.get("with", ""))
    was_asked = driver and driver.facts and driver.facts["asked"] and not other_driver
    awaited, first = _first(site, name, scope) if was_asked else (None, "")
    job, is_awaited, apart = None, False, None
    if driver and other_driver:
        job, is_awaited, apart = compared(site, driver, other_driver, scope)
    both = [shown for shown in (driver, other_driver) if shown]
    conditions = by_condition(site, scope, both, order=params.get("order", ""))
    # The humans' and the drivers' share of trials in which left goes first, by condition.
    shares = (
        [rate(cell["left_first"], cell["merged"]) if cell else rate(0, 0) for cell in cells]
        for cells in (conditions["humans"], *(cells for _, cells in conditions["rows"]))
    )
    return site.render(
        "driver.html",
        view="drivers",
        name=name,
        driver=driver,
        other_driver=other_driver,
        compared=job if is_awaited else None,
        apart=apart,
        linked=True,
        unordered={key: kept for key, kept in params.items() if key != "order"},
        others=[(other, other) for other in by_name if other != name],
        **values | {"human": humans_of(values["table"], driver)},
        awaited=awaited,
        first=first,
        result=search(site.trial_index, trials) if was_asked else None,
        kept=trials,
        attempts=site.trial_index.ask(ATTEMPTS, unmarked(name), scope.prompt),
        accounts=[
            row
            for row in site.trial_index.counts({**trials, "outcome": "collided"}, "account")
            if row["account"]
        ],
        conditions=conditions,
        trials_counted=partial(counted, conditions=conditions),
        counted=_counted([cell for _, cells in conditions["rows"] for cell in cells if cell]),
        rates=zip(*shares, strict=True),
        notes=noted(both, {name: measure.trait for name, measure in MEASURES.items()}),
    )


def _counted(cells: Sequence[Mapping[str, Any]]) -> list[tuple[str, str, str]]:
    """Return the counts to show by situation: heading, and the names of counts k and n.

    Where an ego was on the right, its going first is counted too, on either side.
    """
    egos = [side for side in SIDES if any(cell[f"ego_merged_{side}"] for cell in cells)]
    left = "Left, the ego, goes first" if egos == ["left"] else "Left goes first"
    return [
        (left, "left_first", "merged"),
        *(
            (f"Ego on the {side} goes first", f"ego_first_{side}", f"ego_merged_{side}")
            for side in (egos if "right" in egos else ())
        ),
        ("Crashes", "collided", "ended"),
    ]


def _first(site: Site, driver: str, scope: Scope) -> tuple[Job | None, str]:
    """Return the job to wait for, and a driver's first actions in sentences."""
    job, table = site.table("first-action", scope.sweep, scope.condition)
    sentences = []
    for row in table.rows if table else []:
        is_compared = row.groups[0] in {f"{driver}/{scope.prompt}", HUMAN}
        if table and is_compared and row.values.get("slope_ci"):
            of = printed(table, row)
            name = "People" if row.groups[0] == HUMAN else driver
            sentences.append(
                f"{name}: {of['brake_percent']} % brake, {of['hold_percent']} % hold, "
                f"{of['go_percent']} % speed up, of {of['n']}. Per m/s that they are faster, they "
                f"{_harder(row)}."
            )
    return None if table else job, with_minus(" ".join(sentences)) if len(sentences) > 1 else ""


def _harder(row: TableRow) -> str:
    """Return by how many m/s² a faster driver brakes, or speeds up, harder; with interval."""
    values: Mapping[str, Any] = row.values
    word, sign = ("brake", -1) if values["slope"] < 0 else ("speed up", 1)
    low, high = sorted(sign * end for end in values["slope_ci"])
    return f"{word} {sign * values['slope']:.2f} m/s² harder [{low:.2f}, {high:.2f}]"
