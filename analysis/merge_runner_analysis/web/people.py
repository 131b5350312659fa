"""Likeness to people in raw counts, as the verdicts have it: on the first page of a study."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from merge_runner.scenarios.merge.conditions import HUMAN_CONDITIONS
from merge_runner_analysis.headlines import clause, share
from merge_runner_analysis.stats.score_interval import wilson
from merge_runner_analysis.web.effect_rows import unbroken
from merge_runner_analysis.web.judged import Driver
from merge_runner_analysis.web.marks import Cell
from merge_runner_analysis.wording import (
    DIFFERS,
    HEADINGS,
    IN_ANOTHER,
    MARGINS,
    MEASURES,
    OPEN,
    PLAYED_RULES,
    RULES_MEAN,
    VERDICT_RULES,
    brackets,
    has_verdict,
    number,
    shown_state,
    verdict_word,
)

# Notes on measures that no situation allows.
UNPOSED = {
    "headway": "No situation of this study that people also drove has one driver ahead",
    "velocity": "No situation of this study that people also drove has both side by side at "
    "different speeds",
}


@dataclass(frozen=True, slots=True)
class Likeness:
    """One measure of a driver beside people's: a verdict, and what was counted.

    A count has ``k`` and ``n``, any other value a ``text``; ``row`` is the verdict's row. Where the
    count is by another rule than people's, ``surely`` counts crashes by theirs, and ``by_people``
    is the rest of a sentence on them.
    """

    word: str
    is_open: bool
    k: int | None
    n: int | None
    text: str
    row: str
    surely: int = 0
    by_people: str = ""


def other_differences(driver: Driver) -> str:
    """Return how a driver is shown to differ from people in measures without a column, by name."""
    clauses = [
        f"{IN_ANOTHER.format(MEASURES[name].label)}: {clause(cell.values)}"
        for name, cell in driver.cells.items()
        if name not in HEADINGS and shown_state(cell.values) in DIFFERS
    ]
    return "; ".join(clauses)


def likeness_of(driver: Driver) -> dict[str, Likeness]:
    """Return the likeness of a driver by measure; empty where it is not judged."""
    return {name: _likeness(name, driver.cells[name]) for name in HEADINGS if name in driver.cells}


def counted(driver: Driver, conditions: Mapping[str, Any]) -> str:
    """Return how many of a driver's trials are compared, and why no more; empty if all are."""
    if not driver.cells or driver.facts is None:
        return ""
    repeats, shared = repeated(driver, conditions)
    cells = _cells_of(driver, conditions)
    ended = sum(cell["ended"] for cell in cells if cell)
    reasons = {
        "repeat another one": repeats,
        "in situations that nobody drove": ended - shared,
        "did not end": driver.facts["trials"] - ended,
    }
    why = ", ".join(f"{k} {reason}" for reason, k in reasons.items() if k)
    return f"{shared - repeats} counted; not counted: {why}" if why else ""


def equal_trials(drivers: Sequence[Driver], short: Mapping[str, str]) -> str:
    """Return of which drivers most trials went as an earlier one, and count all the same."""
    counts = [
        (short[of.name], of.cells["collisions"].values.get("equal") or 0, of.facts["trials"])
        for of in drivers
        if of.cells and of.facts
    ]
    return ", ".join(f"{k} of {n} trials of {name}" for name, k, n in counts if 2 * k > n)


def repeated(driver: Driver, conditions: Mapping[str, Any]) -> tuple[int, int]:
    """Return how many ended trials repeat another one, of those in situations people drove."""
    _, n = str(driver.cells["collisions"].values.get("counted") or "0 of 0").split(" of ")
    pairs = zip(_cells_of(driver, conditions), conditions["humans"], strict=True)
    shared = sum(cell["ended"] for cell, human in pairs if cell and human)
    return shared - int(n), shared


def _cells_of(driver: Driver, conditions: Mapping[str, Any]) -> list[Any]:
    return next(cells for of, cells in conditions["rows"] if of is driver)


def gap_weights(drivers: Sequence[Driver], short: Mapping[str, str]) -> str:
    """Return of which trials people's gap in their row is, and its range beside other drivers."""
    with_gap = [of for of in drivers if "gap" in of.cells]
    gaps = [gap for of in with_gap if (gap := of.cells["gap"].values["human"]) is not None]
    ends = dict.fromkeys(number(pick(gaps)) for pick in (min, max) if gaps)
    if len(ends) < 2:
        return ""
    return unbroken(
        "People's mean gap depends on the situations, so it is computed for those of each driver: "
        f"{' to '.join(ends)} m. The row of people has the one for {short[drivers[0].name]}"
    )


def could_see(drivers: Sequence[Driver], short: Mapping[str, str]) -> str:
    """Return the least differences from people with 80 % power; empty without any."""
    parts, unknown = [], ""
    for name, unit in {"collisions": "points in crashes", "gap": "m in the gap"}.items():
        values = [(short[of.name], of.cells[name].values) for of in drivers if name in of.cells]
        sizes = {
            driver: of["detectable"]
            for driver, of in values
            if has_verdict(of) and of.get("detectable") is not None
        }
        if sizes:
            ends = min(sizes, key=sizes.__getitem__), max(sizes, key=sizes.__getitem__)
            named = {number(sizes[driver]): f" ({driver})" for driver in ends}
            shown = [size + name * (len(named) > 1) for size, name in named.items()]
            parts.append(f"{' to '.join(shown)} {unit}")
        elif any(of.get("undecided") for _, of in values):
            unknown = "; in crashes unknown, as another crash rule ended some trials"
    return unbroken(", ".join(parts)) + unknown * bool(parts)


def verdict_rules(drivers: Sequence[Driver], gap: Mapping[str, Any]) -> list[str]:
    """Return the rule of a verdict, a line a state, or of none; ``gap`` is people's value."""
    if not any(has_verdict(cell.values) for of in drivers for cell in of.cells.values()):
        return [*VERDICT_RULES[-1:]]
    tests = {
        sum(cell.values.get("p_holm") is not None for cell in of.cells.values())
        for of in drivers
        if any(has_verdict(cell.values) for cell in of.cells.values())
    }
    ends = " to ".join(map(str, dict.fromkeys((min(tests), max(tests))))) if any(tests) else ""
    labels = dict.fromkeys(
        MEASURES[name].label
        for of in drivers
        for name, cell in of.cells.items()
        if cell.values.get("p_holm") is not None
    )
    numbers = f" ({ends}: {'; '.join(labels)})" if ends else ""
    likeness, *others = (rule.format(tests=numbers) for rule in VERDICT_RULES)
    low, high = gap.get("ci") or (0.0, 0.0)
    if (half := (high - low) / 2) > MARGINS["gap"] / 2:
        likeness += (
            ". Hardly any driver can be shown to be like people in the gap, however many trials it "
            f"has: people's mean gap is known only to ± {number(half)} m, from nine pairs"
        )
    return [likeness, *others]


def _likeness(measure: str, cell: Cell) -> Likeness:
    values = cell.values
    word, is_open = verdict_word(values), shown_state(values) in ("", OPEN)
    row = str(values["row"])
    if counted := values.get("counted"):
        k, n = map(int, str(counted).split(" of "))
        text, surely, by_people = unbroken(f"{number(100 * k / n)} %"), 0, ""
        if undecided := values.get("undecided"):
            surely = values["k"] or 0
            bounds = unbroken(f"to {surely + undecided} of {n}, {share(values)} %")
            by_people = f"{bounds} by people's rule: {RULES_MEAN['rectangle']}"
            (rule,) = (of for of, name in PLAYED_RULES.items() if name == values["counted_by"])
            text += f" by the rule played here: {RULES_MEAN[rule]}"
        return Likeness(word, is_open, k, n, text, row, surely, by_people)
    estimate = values.get("estimate")
    known = measure == "gap" and estimate is not None
    ends = brackets(values.get("ci"))
    if estimate is not None and ends == brackets((estimate, estimate)):
        ends = "in every trial"
    text = f"{number(estimate)} m {ends}".rstrip() if known else ""
    return Likeness(word, is_open, None, None, unbroken(text), row)


def people_of(conditions: Mapping[str, Any], human: Mapping[str, Any]) -> dict[str, str]:
    """Return people's results in these conditions, by measure: k of n, share, 95 % interval."""
    rows = [
        (HUMAN_CONDITIONS[name], cell)
        for name, cell in zip(conditions["names"], conditions["humans"], strict=True)
        if cell
    ]
    counts = {"collisions": [(cell["collided"], cell["ended"]) for _, cell in rows]}
    # The side that is expected first; side by side it is the slower one's.
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
