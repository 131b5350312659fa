"""The answer to a study's own question, as the first page and the report show it.

Nothing here is tested or estimated: sentences, rows and charts are of the finished tables
``effects`` and ``levels``. No sentence claims a direction that a corrected p does not carry.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from math import ceil, floor, log10
from typing import Any

from merge_runner.prompts.blocks import title_of
from merge_runner.study.crossing import MODEL, PROMPT
from merge_runner_analysis.metrics import COLLISIONS, GAP, LEFT_FIRST, RMSE
from merge_runner_analysis.tables.model import Row, Table
from merge_runner_analysis.web.marks import Mark
from merge_runner_analysis.wording import (
    ALPHA,
    ENOUGH,
    METRIC_NAMES,
    SAME_TRIALS,
    TIMES,
    brackets,
    capital,
    equal_p,
    joined,
    number,
    p_value,
)

# A change of the measure, as a claim names it.
CHANGED = {LEFT_FIRST.name: "who goes first", RMSE.name: "how far it departs from its speed"}
NO_BREAK = "\N{NO-BREAK SPACE}"
MIDDLE = Mark("", None, None, zero=50.0)  # no difference, on the axis of differences
# More levels that show nothing are counted, not listed.
FEW = 3
# The shapes that tell drivers apart in a chart, and more of them are not drawn.
SHAPES = ("dot", "square", "ring", "triangle")
# Of a chart, in units of its drawing: its parts, and a letter of a name.
LEFT, WIDTH, HEAD, ROW, APART, INDENT, LETTER = 90.0, 480.0, 12, 20, 14, 84.0, 7.5


@dataclass(frozen=True, slots=True)
class Point:
    """A value of a driver in a chart, with its interval."""

    shape: str
    x: float
    ends: tuple[float, float] | None
    y: float
    says: str


@dataclass(frozen=True, slots=True)
class Line:
    """A level of a chart; the first one of a factor is headed by it."""

    y: float
    head: str
    name: str
    points: list[Point]


@dataclass(frozen=True, slots=True)
class Chart:
    """Levels below each other, and the drivers of each by their shapes."""

    title: str
    lines: list[Line]
    ticks: list[tuple[float, str]]
    even: float | None
    height: float
    indent: float
    width: float = WIDTH


@dataclass(frozen=True, slots=True)
class Side:
    """The value of a level in the shared situations; counts of all its trials, and their cells."""

    text: str
    name: str = ""
    k: int | None = None
    n: int | None = None
    row: str = ""
    columns: tuple[str, str] = ("k", "n")


@dataclass(frozen=True, slots=True)
class Change:
    """An effect as a table shows it; ``mark`` is on an axis that ends at ``end`` on both sides."""

    name: str
    said: str
    reference: Side | None
    level: Side | None
    difference: str
    interval: str
    p: str
    mark: Mark | None
    end: str
    is_primary: bool
    row: str


@dataclass(frozen=True, slots=True)
class Answer:
    """The claim, what else there is to say, charts, and the effects behind them.

    ``asked`` is the question in words, for a study that has none of its own.
    """

    asked: str
    claim: str
    rest: str
    measure: str
    drivers: list[tuple[str, str]]
    trials: int
    halves: bool
    charts: list[Chart]
    crossings: str
    changes: list[Change]
    others: list[Change]
    could: str


def answer_of(effects: Table | None, levels: Table | None) -> Answer | None:
    """The answer; None where no table is there, or the study asks about no factor."""
    if effects is None or levels is None:
        return None
    # Of a driver that is not judged there is a row without values.
    known = [row for row in levels.rows if row.values.get("factor")]
    sides = {row.id: row for row in known}
    claim, rest = answered(effects.rows)
    if not claim:
        return None
    asked = [row for row in effects.rows if row.values.get("primary")]
    primary = min(asked, key=lambda row: _number(row, "p") if _tested(row) else 1.0)
    metric = metric_of(primary)
    own = [row for row in effects.rows if metric_of(row) == metric]
    named = {LEFT_FIRST.name, COLLISIONS.name, GAP.name, RMSE.name}
    others = [
        row
        for row in effects.rows
        if metric_of(row) in named - {metric} and not _crossed(row) and _tested(row)
        and row.values["factor"] != MODEL
    ]  # fmt: skip
    drivers = list(
        dict.fromkeys(str(row.values["driver"]) for row in known if row.values["driver"])
    )
    drawn = drivers if len(drivers) <= len(SHAPES) else []
    shapes = dict(zip(drawn, SHAPES, strict=False))
    shown = [row for row in known if not _untested(effects.rows) & _names(row)]
    charts = [
        _chart("By factor", [r for r in shown if len(_names(r)) == 1], shapes, metric),
        _chart(_crossing_of(shown), [r for r in shown if len(_names(r)) > 1], shapes, metric),
    ]
    tested = [row for row in own if _tested(row)]
    names = _factors(asked)
    return Answer(
        f"{'Does' if len(names) == 1 else 'Do'} {joined(names)} change {_changed(primary)}?",
        unbroken(claim),
        unbroken(rest),
        capital(name_of(primary)),
        [*shapes.items()],
        sum(_count(row, "n") for row in _of_one_factor(shown, drawn)),
        any(row.values["k"] is None for row in known) and metric == LEFT_FIRST.name,
        [chart for chart in charts if chart],
        unbroken(_interactions(tested, {str(row.values["factor"]) for row in known})),
        _changes(tested, sides, metric),
        _changes(others, sides, metric),
        unbroken(_could(tested)),
    )


def answered(rows: Sequence[Row]) -> tuple[str, str]:
    """The answer in a sentence, and the rest; empty where no primary test was made.

    The claim is the surest of the primary tests whose corrected p is below 5 %; where there is
    none it says so, and the rest what could have been seen. It is of scripted stand-ins only where
    there is no other driver, and then says so.
    """
    unscripted = [row for row in rows if not row.values.get("drivers")]
    rehearsed = "" if unscripted else "In a rehearsal with a scripted stand-in, "
    rows = unscripted or rows
    tested = [row for row in rows if _tested(row)]
    primary = sorted(
        (row for row in tested if row.values.get("primary")), key=lambda row: _number(row, "p")
    )
    copied = [f"{_level(row)} is {row.note}" for row in rows if _copied(row)]
    if not primary:
        return capital(rehearsed + f"{'; '.join(copied)}.") if copied else "", ""
    what = _changed(primary[0])
    if few := [
        row for row in primary if min(_count(row, "n"), _count(row, "n_reference")) < ENOUGH
    ]:
        counts = sorted(_count(row, name) for row in few for name in ("n", "n_reference"))
        trials = " to ".join(dict.fromkeys(map(str, (counts[0], counts[-1]))))
        asked = f"whether {joined(_factors(few))} changes {what}"
        return capital(f"{rehearsed}too few trials finished to say {asked}: {trials} a level."), ""
    sure = [row for row in primary if _shown(row)]
    rest = []
    if sure:
        first = sure[0]
        claim = f"{rehearsed}{first.values['factor']} changes {what}: {_both(first)}."
        rest.append(f"The difference is {_apart(first)}, corrected p {_p(first)}.")
    else:
        claim = f"{rehearsed}no change of {what} is shown by {joined(_factors(primary))}."
    rest += [
        f"{capital(_level(row))} changes it, too: {_apart(row)}, corrected p {_p(row)}."
        for row in sure[1:]
    ]
    rest += _not_shown([row for row in primary if row not in sure])
    rest += [f"{capital(said)}." for said in copied]
    if not sure:
        rest.append(_seen(primary))
    crossed = [row for row in tested if _crossed(row) and metric_of(row) == metric_of(primary[0])]
    rest += [
        f"{_named(row)} interact: {_apart(row)}, corrected p {_p(row)}."
        for row in crossed
        if _shown(row)
    ]
    also = [row for row in tested if _shown(row) and not _crossed(row) and row not in primary]
    also = [row for row in also if row.values["factor"] != MODEL and metric_of(row) in METRIC_NAMES]
    if not sure and also:
        row = min(also, key=lambda row: _number(row, "p"))
        rest.append(f"{capital(str(row.values['factor']))} changes {_changed(row)}: {_both(row)}.")
    return capital(claim), " ".join(filter(None, rest))


def _not_shown(rows: Sequence[Row]) -> Iterator[str]:
    """The primary tests that show nothing, by their p; of more than FEW the first one alone."""
    if len(rows) > FEW:
        yield (
            f"{len(rows)} levels are not shown to change it; {_level(rows[0])} comes nearest: "
            f"{_apart(rows[0])}, corrected p {_p(rows[0])}."
        )
        return
    for row in rows:
        yield (
            f"{capital(_level(row))} is not shown to change it: {_apart(row)}, "
            f"corrected p {_p(row)}."
        )


def unbroken(text: str) -> str:
    """The text, of which no number stands apart from its unit or within its interval."""
    return re.sub(r"(?<=\d) (?=[%m]|points)|(?<=\d,) (?=[−\d])|(?<=[<=]) (?=\d)|^ ", NO_BREAK, text)


def _interactions(rows: Sequence[Row], drawn: set[str]) -> str:
    """Of two factors whose combinations are drawn, whether they interact."""
    crossed = {name for names in drawn if TIMES in names for name in names.split(TIMES)}
    said = []
    for row in rows:
        if _crossed(row) and crossed >= {*str(row.values["factor"]).split(TIMES)}:
            what = "they interact" if _shown(row) else "no interaction is shown"
            said.append(f"{row.values['factor']}: {what}, {_apart(row)}, corrected p {_p(row)}.")
    return " ".join(said)


def _could(rows: Sequence[Row]) -> str:
    """What the tests of the primary measure could have seen, of factors and of interactions."""
    main = [row for row in rows if row.values.get("primary")]
    crossed = [row for row in rows if _crossed(row)]
    return " ".join(filter(None, (_seen(main), _seen(crossed, "An interaction"))))


def _seen(rows: Sequence[Row], what: str = "A change") -> str:
    known = [_number(row, "detectable") for row in rows if row.values.get("detectable") is not None]
    if not known:
        return ""
    least = f"{number(max(known))} {unit_of(rows[0])}"
    return f"{what} of {least} or more would have been seen in four of five studies."


def _factors(rows: Iterable[Row]) -> list[str]:
    return list(dict.fromkeys(str(row.values["factor"]) for row in rows))


def _both(row: Row) -> str:
    """``in the same situations, the driver goes first in 63.00 % with hurry=yes and ...``."""
    factor, level, base = (row.values[name] for name in ("factor", "level", "reference"))
    of, reference = (_estimate(row, name) for name in ("estimate", "estimate_reference"))
    if metric_of(row) == LEFT_FIRST.name:
        return (
            f"in the same situations, the driver goes first in {of} with {factor}={level} and in "
            f"{reference} with {factor}={base}"
        )
    name = f"{name_of(row)} " if unit_of(row) == "points" else ""
    return f"{name}{of} with {factor}={level}, {reference} with {factor}={base}"


def _estimate(row: Row, name: str) -> str:
    return f"{number(_number(row, name))} {unit_of(row).replace('points', '%')}"


def _apart(row: Row) -> str:
    """``+12.84 points [6.06, 19.60]``."""
    return f"{_difference(row)} {unit_of(row)} {brackets(_interval(row))}".rstrip()


def _difference(row: Row) -> str:
    value = _number(row, "difference")
    return f"{'+' if value > 0 else ''}{number(value)}"


def _p(row: Row) -> str:
    return equal_p(_number(row, "p_corrected"))


def _number(row: Row, name: str) -> float:
    value: Any = row.values[name]
    return float(value)


def _count(row: Row, name: str) -> int:
    return int(_number(row, name))


def _interval(row: Row) -> tuple[float, float] | None:
    ends = row.values.get("ci")
    return ends if isinstance(ends, tuple) else None


def metric_of(row: Row) -> str:
    """The metric of an effect, by its name."""
    return row.id.rpartition("/")[2]


def name_of(row: Row) -> str:
    """What an effect's measure is called."""
    return METRIC_NAMES.get(metric_of(row), str(row.values["measure"]).rpartition(" (")[0])


def _changed(row: Row) -> str:
    """``who goes first``: an effect's measure as a claim names it."""
    return CHANGED.get(metric_of(row), name_of(row))


def unit_of(row: Row) -> str:
    """The unit of a difference."""
    return str(row.values["measure"]).rpartition("(")[2].rstrip(")").replace("%", "points")


def _level(row: Row) -> str:
    return f"{row.values['factor']}={row.values['level']}"


def _named(row: Row) -> str:
    return capital(str(row.values["factor"]).replace(TIMES, " and "))


def _crossed(row: Row) -> bool:
    return "/interaction/" in row.id


def _copied(row: Row) -> bool:
    """Whether it is a test of the study's own that could not be made, of equal trials."""
    return bool(row.values.get("primary")) and row.note == SAME_TRIALS


def _tested(row: Row) -> bool:
    return row.values.get("p_corrected") is not None


def _shown(row: Row) -> bool:
    return _tested(row) and _number(row, "p_corrected") < ALPHA


def _changes(rows: Sequence[Row], sides: dict[str, Row], primary: str) -> list[Change]:
    """The effects with both sides of each; those of a measure have one axis."""
    ends: dict[str, float] = {}
    for row in rows:
        values = (_number(row, "difference"), *(_interval(row) or ()))
        ends[metric_of(row)] = max(ends.get(metric_of(row), 0.0), *map(abs, values))
    return [_change(row, sides, ends[metric_of(row)], primary) for row in rows]


def _change(row: Row, sides: dict[str, Row], end: float, primary: str) -> Change:
    of, base, metric = row.values["level"], row.values["reference"], metric_of(row)
    named = title_of if row.values["factor"] == PROMPT else str
    mark = " [scripted]" if str(of).endswith(" [scripted]") else ""
    is_own = metric == primary
    reference, level = (
        None
        if _crossed(row)
        else _side(
            Side(unbroken(_estimate(row, name)), named(str(side))),
            sides.get(f"{row.values['factor']}={side}"),
            is_own,
            metric,
        )
        for name, side in (("estimate_reference", f"{base}{mark}"), ("estimate", of))
    )
    # Of an interaction the id has both levels.
    said = row.id.partition("/interaction/")[0].replace("/", ", ") if _crossed(row) else ""
    said = said or (named(str(of)) if is_own else f"{row.values['factor']}: {named(str(of))}")
    if is_own and row.values.get("primary"):
        said += ", primary"
    return Change(
        capital(str(row.values["factor"])) if is_own else capital(name_of(row)),
        said,
        reference,
        level,
        f"{_difference(row)} {unit_of(row)}",
        brackets(_interval(row)),
        p_value(_number(row, "p_corrected")),
        difference_mark(row, end),
        f"{number(end)} {unit_of(row)}",
        bool(row.values.get("primary")),
        row.id,
    )


def difference_mark(row: Row, end: float) -> Mark:
    """A difference on an axis with 0 in its middle; filled where its corrected p is below 5 %."""
    values = (_number(row, "difference"), *(_interval(row) or ()))
    at, *ends = (round(50 + 48 * value / (end or 1.0), 2) for value in values)
    shape = "like" if _shown(row) else "open"
    return Mark(shape, at, (ends[0], ends[1]) if ends else None, zero=50.0)


def _side(side: Side, counts: Row | None, is_own: bool, metric: str) -> Side:
    """One side of an effect, with its counts by a row of ``levels``."""
    columns = ("k", "n") if is_own else ("crashed", "ended")
    if counts is None or not (is_own or metric == COLLISIONS.name):
        return side
    values: Any = counts.values
    return replace(side, k=values[columns[0]], n=values[columns[1]], row=counts.id, columns=columns)


def _names(row: Row) -> set[str]:
    """The factor of a level, or those of a crossing."""
    return {*str(row.values["factor"]).split(TIMES)}


def _untested(effects: Sequence[Row]) -> set[str]:
    """The factors of which every level has the trials of its reference."""
    asked = [row for row in effects if row.values.get("primary")]
    return {*_factors(asked)} - {*_factors(row for row in asked if not _copied(row))}


def _crossing_of(levels: Sequence[Row]) -> str:
    """``In combination: hurry, persona``."""
    crossed = [str(row.values["factor"]) for row in levels if len(_names(row)) > 1]
    return f"In combination: {', '.join(crossed[0].split(TIMES))}" if crossed else ""


def _of_one_factor(levels: Sequence[Row], drivers: Sequence[str]) -> list[Row]:
    """The rows of the first drawn factor's levels, of all ``drivers``: every trial once."""
    drawn = [
        row
        for row in levels
        if row.values["factor"] != MODEL and (row.values["driver"] or "") in (drivers or [""])
    ]
    return [row for row in drawn if row.values["factor"] == drawn[0].values["factor"]]


def _chart(title: str, rows: Sequence[Row], shapes: dict[str, str], metric: str) -> Chart | None:
    """The levels of these rows, each with a point for each driver, on one axis from the data."""
    of_model = [row for row in rows if row.values["factor"] != MODEL]
    drawn = [
        row
        for row in of_model
        if row.values["driver"] in shapes and row.values["value"] is not None
    ]
    if not shapes:
        drawn = [
            row for row in of_model if not row.values["driver"] and row.values["value"] is not None
        ]
    if not drawn:
        return None
    ends = [end for row in drawn for end in (_interval(row) or (_number(row, "value"),))]
    low, high, step = _axis(min(ends), max(ends))

    levels = dict.fromkeys((str(row.values["factor"]), str(row.values["level"])) for row in drawn)
    names = {(f, name): title_of(name) if f == PROMPT else name for f, name in levels}
    indent = 0.0 if TIMES in next(iter(levels))[0] else INDENT
    left = min(WIDTH / 2, indent + max(LEFT, LETTER * max(map(len, names.values()))))

    def x(value: float) -> float:
        return round(left + (WIDTH - left) * (value - low) / (high - low), 1)

    lines: list[Line] = []
    y, heads = float(HEAD), set[str]()
    for factor, name in levels:
        points: list[Point] = []
        y += ROW if factor in heads or not lines else 1.5 * ROW
        for row in drawn:
            if (row.values["factor"], row.values["level"]) != (factor, name):
                continue
            ci = _interval(row)
            driver, value = row.values["driver"] or "all drivers", number(_number(row, "value"))
            says = f"{driver}: {_counts(row)}{value} {brackets(ci)}".rstrip()
            points.append(
                Point(
                    shapes.get(str(row.values["driver"]), SHAPES[0]),
                    x(_number(row, "value")),
                    None if ci is None else (x(ci[0]), x(ci[1])),
                    y + APART * len(points),
                    says,
                )
            )
        head = "" if factor in heads or TIMES in factor else factor
        lines.append(Line(y + APART * (len(points) - 1) / 2, head, names[factor, name], points))
        heads.add(factor)
        y += APART * (len(points) - 1)
    ticks = [low + step * place for place in range(round((high - low) / step) + 1)]
    percent = metric.endswith("_percent")
    even = 50.0 if metric == LEFT_FIRST.name and low < 50 < high else None
    return Chart(
        title,
        lines,
        [(x(tick), f"{tick:g} %" if percent else f"{tick:g}") for tick in ticks],
        None if even is None else x(even),
        y + ROW + 16,
        indent,
    )


def _counts(row: Row) -> str:
    return "" if row.values.get("k") is None else f"{_counted(row)}, "


def _counted(row: Row) -> str:
    return f"{row.values['k']} of {row.values['n']}"


def _axis(low: float, high: float) -> tuple[float, float, float]:
    """Round ends around these values, and the step of four or so ticks between."""
    width = (high - low) or 1.0
    power = 10 ** floor(log10(width / 4))
    step = next(power * of for of in (1, 2, 5, 10) if power * of >= width / 5)
    return step * floor(low / step), step * ceil(high / step), step
