"""Verdicts as marks on an axis: places in percent, so that no picture is stretched."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace

from merge_runner_analysis.headlines import share
from merge_runner_analysis.stats.score_interval import wilson
from merge_runner_analysis.tables.model import Row
from merge_runner_analysis.wording import (
    MEASURES,
    OPEN,
    OPPOSITE,
    SHOWN,
    STRONGER,
    UNDIRECTED,
    UNLIKE,
    WEAKER,
    Measure,
    Values,
    ends_of,
    number,
    shown_state,
    verdict_word,
)

SHAPES = {
    SHOWN: "like",
    WEAKER: "weaker",
    STRONGER: "stronger",
    **dict.fromkeys((UNLIKE, OPPOSITE, UNDIRECTED), "unlike"),
    OPEN: "open",
}


@dataclass(frozen=True, slots=True)
class Mark:
    """A value on an axis with its shape, its interval and 0; outside the axis it is an arrow."""

    shape: str
    at: float | None
    ends: tuple[float, float] | None
    arrow: str = ""
    zero: float | None = None


@dataclass(frozen=True, slots=True)
class Cell:
    """A verdict on a page; ``words`` is its full text, with its note."""

    values: Values
    mark: Mark | None
    text: str
    interval: str
    verdict: str
    words: str


def place(measure: Measure, value: float) -> float:
    """Return the place of a value on a measure's axis in percent; values beyond lie at its end."""
    low, high = measure.ends
    return round(min(max(100 * (value - low) / (high - low), 0.0), 100.0), 2)


def mark(measure: Measure, values: Values) -> Mark | None:
    """Return the mark of a verdict; None without a value or an interval."""
    value, ci, (low, high) = values.get("estimate"), values.get("ci"), measure.ends
    ends = None if ci is None else (place(measure, ci[0]), place(measure, ci[1]))
    if value is None:
        return None if ends is None else Mark("", None, ends)
    shape = SHAPES.get(shown_state(values), "plain")
    arrow = "beyond" if value > high else "below" if value < low else ""
    return Mark(shape, place(measure, value), ends, arrow)


def rate(count: int, of: int) -> Mark:
    """Return the mark of a share from 0 to 100 %, with its score interval; empty for 0 trials."""
    if not of:
        return Mark("", None, None)
    low, high = wilson(count / of, of)
    return Mark("plain", round(100 * count / of, 2), (round(100 * low, 2), round(100 * high, 2)))


def band(measure: Measure, human: Values) -> Mark:
    """Return the humans' value and interval on the axis, and 0 where it lies inside."""
    value, (low, high) = human.get("estimate"), measure.ends
    if measure.margin is not None and human.get("ci") is None and value is not None:
        human = {**human, "ci": (value - measure.margin, value + measure.margin)}
    human_mark = mark(measure, human) or Mark("", None, None)
    zero = place(measure, 0.0) if low < 0 < high else None
    return replace(human_mark, zero=zero)


def measures_of(rows: Iterable[Row]) -> dict[str, Measure]:
    """Return the measures of these verdicts; a share beyond its axis gets one up to 100 %."""
    measures = dict(MEASURES)
    for row in rows:
        measure, value = measures.get(str(row.values.get("measure"))), row.values.get("estimate")
        if not measure or measure.unit != "% of trials" or not isinstance(value, float):
            continue
        if value > measure.ends[1]:
            measures[measure.name] = replace(measure, ends=(0.0, 100.0))
    return measures


def cells(verdicts: dict[str, Values], measures: Mapping[str, Measure]) -> dict[str, Cell]:
    """Return the verdicts of a driver and prompt by measure; empty where it is not judged."""
    if "" in verdicts:
        return {}
    return {name: _cell(measures[name], values) for name, values in verdicts.items()}


def _cell(measure: Measure, values: Values) -> Cell:
    value, ends = values.get("estimate"), ends_of(values)
    word = verdict_word(values) if values.get("kind") != "humans" else ""
    whole = share(values) if values.get("undecided") else f"{number(value)} {ends}".rstrip()
    parts = [f"{whole} {measure.unit}", word, f"n = {values['n']}", values["note"]]
    return Cell(
        values,
        mark(measure, values),
        share(values) if values.get("undecided") else number(value),
        ends,
        word,
        "; ".join(filter(None, parts)),
    )
