"""Likeness to people in raw counts, as the verdicts have it: on the first page of a study."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from merge_runner.scenarios.merge.conditions import HUMAN_CONDITIONS
from merge_runner_analysis.stats.score_interval import wilson
from merge_runner_analysis.web.effect_rows import unbroken
from merge_runner_analysis.web.judged import Driver
from merge_runner_analysis.web.marks import Cell
from merge_runner_analysis.wording import (
    OPEN,
    SHOWN,
    STRONGER,
    UNLIKE,
    WEAKER,
    Values,
    brackets,
    number,
    shown_state,
)

HEADINGS = {
    "collisions": "Crashes",
    "headway": "The one ahead goes first",
    "velocity": "Side by side, the slower goes first",
    "gap": "Gap at the merge point",
}
# So far from people, in points and in m, a driver still is like them.
MARGINS = {"collisions": 5.0, "gap": 1.0}
LIKE, MORE, LESS, CANNOT_TELL = "●", "▲", "▼", "○"
WORDS = {
    "collisions": {MORE: "crashes more", LESS: "crashes less"},
    "gap": {MORE: "larger", LESS: "smaller"},
}
STATES = {
    SHOWN: (LIKE, "like people"),
    STRONGER: (MORE, "more than with people"),
    WEAKER: (LESS, "less than with people"),
    UNLIKE: (LESS, "not as with people"),
}


@dataclass(frozen=True, slots=True)
class Likeness:
    """One measure of a driver beside people's: a mark with its word, and what was counted.

    Of a count there are ``k`` and ``n``, else a value as ``text``; ``row`` is that of the verdict.
    """

    mark: str
    word: str
    k: int | None
    n: int | None
    text: str
    row: str


def likeness_of(driver: Driver) -> dict[str, Likeness]:
    """The likeness of a driver by measure; empty where it is not judged."""
    return {name: _likeness(driver.cells[name]) for name in HEADINGS if name in driver.cells}


def _likeness(cell: Cell) -> Likeness:
    values = cell.values
    mark, word = _mark(cell.measure.name, values)
    row, counted = str(values["row"]), values.get("counted")
    if counted:
        k, n = map(int, str(counted).split(" of "))
        return Likeness(mark, word, k, n, unbroken(f"{number(100 * k / n)} %"), row)
    estimate = values.get("estimate")
    known = cell.measure.name == "gap" and estimate is not None
    text = f"{number(estimate)} m {brackets(values.get('ci'))}".rstrip() if known else ""
    return Likeness(mark, word, None, None, unbroken(text), row)


def _mark(name: str, values: Values) -> tuple[str, str]:
    """What a verdict says: alike, different and in which direction, or that it cannot be told.

    The interval of a difference has the level that the verdict rests on, of 95 % or more.
    """
    state, ci = shown_state(values), values.get("difference_ci")
    if name not in MARGINS:
        return STATES.get(state, (CANNOT_TELL, "cannot tell yet"))
    if ci is not None and max(-ci[0], ci[1]) <= MARGINS[name]:
        return LIKE, "like people"
    if state in ("", OPEN):
        return CANNOT_TELL, "cannot tell yet"
    mark = MORE if values["difference"] > 0 else LESS
    return mark, WORDS[name][mark]


def people_of(conditions: Mapping[str, Any], human: Mapping[str, Any]) -> dict[str, str]:
    """What people did in these conditions, by measure: counts with share and 95 % interval."""
    rows = [
        (HUMAN_CONDITIONS[name], cell)
        for name, cell in zip(conditions["names"], conditions["humans"], strict=True)
        if cell
    ]
    counts = {"collisions": [(cell["collided"], cell["ended"]) for _, cell in rows]}
    # The side that is expected first: of two that are side by side that of the slower one.
    expected = {
        "headway": [(at.projected_headway_m, cell) for at, cell in rows],
        "velocity": [
            (-at.relative_velocity_mps, cell) for at, cell in rows if not at.projected_headway_m
        ],
    }
    for name, cells in expected.items():
        counts[name] = [
            (cell["left_first" if ahead > 0 else "right_first"], cell["merged"])
            for ahead, cell in cells
            if ahead
        ]
    gap = human["cells"].get("gap")
    shown = {"gap": unbroken(f"{gap.text} m {gap.interval}".rstrip())} if gap else {}
    for name, parts in counts.items():
        k, n = (sum(part) for part in zip(*parts, strict=True)) if parts else (0, 0)
        if n:
            ends = brackets([100 * end for end in wilson(k / n, n)])
            shown[name] = f"{k} of {n}, " + unbroken(f"{number(100 * k / n)} % {ends}")
    return shown
