"""Likeness to people in raw counts, as the verdicts have it: on the first page of a study."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from merge_runner.scenarios.merge.conditions import HUMAN_CONDITIONS
from merge_runner_analysis.stats.score_interval import wilson
from merge_runner_analysis.web.effect_rows import unbroken
from merge_runner_analysis.web.judged import Driver
from merge_runner_analysis.web.marks import Cell
from merge_runner_analysis.wording import (
    HEADINGS,
    OPEN,
    SHOWN,
    STRONGER,
    UNLIKE,
    WEAKER,
    brackets,
    number,
    shown_state,
    verdict_word,
)

MARKS = {SHOWN: "●", STRONGER: "▲", WEAKER: "▼", UNLIKE: "✕", OPEN: "○"}


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
    """Return the likeness of a driver by measure; empty where it is not judged."""
    return {name: _likeness(driver.cells[name]) for name in HEADINGS if name in driver.cells}


def could_see(drivers: Sequence[Driver]) -> str:
    """Return the differences from people that four of five studies find; empty without any."""
    parts = []
    for name, unit in {"collisions": "points in crashes", "gap": "m in the gap"}.items():
        values = [driver.cells[name].values for driver in drivers if name in driver.cells]
        sizes = [of["detectable"] for of in values if of.get("detectable") is not None]
        if sizes:
            ends = dict.fromkeys(number(size) for size in (min(sizes), max(sizes)))
            parts.append(f"{' to '.join(ends)} {unit}")
    of_driver = ", depending on the driver" if any(" to " in part for part in parts) else ""
    return unbroken(" or ".join(parts)) + of_driver


def _likeness(cell: Cell) -> Likeness:
    values = cell.values
    mark, word = MARKS.get(shown_state(values), MARKS[OPEN]), verdict_word(values)
    row, counted = str(values["row"]), values.get("counted")
    if counted:
        k, n = map(int, str(counted).split(" of "))
        share = f"{number(100 * k / n)} %"
        if values.get("undecided"):  # it is not by people's rule
            share += f" by {values['counted_by']}"
        return Likeness(mark, word, k, n, unbroken(share), row)
    estimate = values.get("estimate")
    known = cell.measure.name == "gap" and estimate is not None
    text = f"{number(estimate)} m {brackets(values.get('ci'))}".rstrip() if known else ""
    return Likeness(mark, word, None, None, unbroken(text), row)


def people_of(conditions: Mapping[str, Any], human: Mapping[str, Any]) -> dict[str, str]:
    """Return people's results in these conditions, by measure: k of n, share, 95 % interval."""
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
