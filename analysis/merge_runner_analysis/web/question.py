"""The answer to a study's own question, as the first page and the report show it.

Nothing here is tested or estimated: sentences, rows and charts are of the finished tables
``effects`` and ``levels``. No sentence claims a direction that a corrected p does not carry.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

from merge_runner.study.arms import MODEL, OPPONENT
from merge_runner_analysis.metrics import COLLISIONS, LEFT_FIRST
from merge_runner_analysis.tables.model import Row, Table
from merge_runner_analysis.web.claims import SEEN, answered, called, changed, factors_named, sizes
from merge_runner_analysis.web.effect_rows import (
    amount,
    count_of,
    difference_mark,
    difference_text,
    ends_of,
    estimate_text,
    factors_of,
    interval_of,
    interval_text,
    is_copied,
    is_interaction,
    is_none_or_all,
    is_shown,
    is_tested,
    level_text,
    metric_of,
    name_of,
    test_text,
    unbroken,
    unit_of,
    value_of,
)
from merge_runner_analysis.web.level_chart import SHAPES, Chart, level_chart
from merge_runner_analysis.web.marks import Mark
from merge_runner_analysis.web.names import short_names
from merge_runner_analysis.wording import (
    CORRECTED,
    EGO,
    LEFT,
    PLANTED,
    TIMES,
    UNREADABLE,
    WORDS,
    capital,
    joined,
    number,
    p_value,
)


@dataclass(frozen=True, slots=True)
class Side:
    """The value of a level in the shared situations; counts of all its trials, and their cells.

    Where some trials count half, ``halves`` has the count.
    """

    text: str
    name: str = ""
    k: int | None = None
    halves: str = ""
    n: int | None = None
    row: str = ""
    columns: tuple[str, str] = ("k", "n")


@dataclass(frozen=True, slots=True)
class Change:
    """An effect as a table shows it; ``mark`` is on an axis that ends at ``end`` on both sides."""

    name: str
    detail: str
    reference: Side | None
    level: Side | None
    difference: str
    interval: str
    p: str
    is_shown: bool
    mark: Mark
    end: str
    row: str


@dataclass(frozen=True, slots=True)
class Answer:
    """The claim, what else there is to say, charts, and the effects behind them.

    ``asked`` is the question in words, for a study that has none of its own; ``crossed`` a factor
    at whose levels another one may be shown. ``who`` says of which driver who goes first is
    counted, ``corrected`` for which tests p is corrected, and ``problem`` what is wrong with the
    stored study. The charts are ``adjusted`` if their points are the values of the changes, and
    ``is_cut`` if an interval ends beyond their axis.
    """

    asked: str
    claim: str
    rest: str
    measure: str
    is_cut: bool
    drivers: list[tuple[str, str]]
    counted: str
    who: str
    corrected: str
    charts: list[Chart]
    adjusted: bool
    crossed: str
    crossings: str
    changes: list[Change]
    others: list[Change]
    could: str
    problem: str


def answer_of(effects: Table | None, levels: Table | None) -> Answer | None:
    """Return the answer; None without a table, or where the study asks about no factor."""
    if effects is None or levels is None:
        return None
    who = _note(levels, LEFT[1]) or _note(levels, EGO[1])
    driver, _ = LEFT if who == LEFT[1] else EGO
    claim, rest = answered(effects.rows, driver, _note(effects, PLANTED))
    if not claim:
        return None
    # A driver that is not judged has a row without values.
    known = [row for row in levels.rows if row.values.get("factor")]
    asked = [row for row in effects.rows if row.values.get("primary")]
    primary = min(asked, key=lambda row: value_of(row, "p") if is_tested(row) else 1.0)
    metric, names = metric_of(primary), factors_named(asked)
    of_metric = [row for row in effects.rows if metric_of(row) == metric]
    tested = [row for row in of_metric if is_tested(row)]
    others = [row for row in effects.rows if _is_other(row, metric)]
    shapes = _shapes(known)
    short = short_names([*shapes])
    shown = [row for row in known if not _untested(asked) & factors_of(row)]
    single = [row for row in shown if len(factors_of(row)) == 1]
    if is_adjusted := len(shapes) < 2:
        single = _adjusted(single, of_metric)
    crossed = [row for row in shown if len(factors_of(row)) > 1]
    charts = [
        level_chart("By factor", single, shapes, metric),
        level_chart(_crossing_of(shown), crossed, shapes, metric),
    ]
    sides = {row.id: row for row in known}
    return Answer(
        f"{'Does' if len(names) == 1 else 'Do'} {joined(names)} change {changed(primary)}?",
        unbroken(claim),
        unbroken(rest),
        capital(name_of(primary)),
        any(end < 0 or end > 100 for row in single for end in interval_of(row) or ())
        and metric.endswith("_percent"),
        [(short[driver], shape) for driver, shape in shapes.items()],
        _counted(_of_one_factor(shown, [*shapes]), metric, effects.rows),
        capital(who),
        _note(effects, CORRECTED),
        [chart for chart in charts if chart],
        is_adjusted,
        (OPPONENT if OPPONENT in names else names[-1]) if len(names) > 1 else "",
        unbroken(_interactions(tested, {str(row.values["factor"]) for row in known})),
        _changes(tested, sides, metric, _words(effects)),
        _changes(others, sides, metric, {}),
        unbroken(_could([*tested, *others])),
        _note(effects, UNREADABLE),
    )


def _note(table: Table, start: str) -> str:
    """Return the first note of a table that starts so, or nothing."""
    return next((note for note in table.notes if note.startswith(start)), "")


def _words(effects: Table) -> dict[str, str]:
    """Return the words of levels, by ``factor=level``."""
    notes = [note.removeprefix(WORDS) for note in effects.notes if note.startswith(WORDS)]
    return dict(note.split(": ", 1) for note in notes)


def _is_other(row: Row, metric: str) -> bool:
    """Return whether an effect is shown besides those on the study's ``metric``."""
    return (
        metric_of(row) in {LEFT_FIRST.name, *SEEN} - {metric}
        and not is_interaction(row)
        and is_tested(row)
        and not is_none_or_all(row)
        and row.values["factor"] != MODEL
    )


def _shapes(levels: Sequence[Row]) -> dict[str, str]:
    """Return the shape of each driver in charts; empty where there are too many."""
    drivers = dict.fromkeys(str(row.values["driver"]) for row in levels if row.values["driver"])
    return dict(zip(drivers, SHAPES, strict=False)) if len(drivers) <= len(SHAPES) else {}


def _interactions(rows: Sequence[Row], drawn: set[str]) -> str:
    """Describe the interactions of factors whose combinations are drawn."""
    crossed = {name for names in drawn if TIMES in names for name in names.split(TIMES)}
    texts = []
    for row in rows:
        if is_interaction(row) and crossed >= {*str(row.values["factor"]).split(TIMES)}:
            what = "they interact" if is_shown(row) else "no interaction is shown"
            texts.append(f"{row.values['factor']}: {what}, {test_text(row)}.")
    return " ".join(texts)


def _could(rows: Sequence[Row]) -> str:
    """Return the minimum detectable effects by measure: ``goes first 4.26 points (hurry)``."""
    names = dict.fromkeys(map(name_of, rows))
    least = {name: sizes([row for row in rows if name_of(row) == name]) for name in names}
    return "; ".join(f"{name} {size}" for name, size in least.items() if size)


def _adjusted(levels: Sequence[Row], effects: Sequence[Row]) -> list[Row]:
    """Return levels with their values in the effects; the interval is that of the difference.

    A reference has a row for each value that it has beside other levels, and no interval.
    """
    adjusted: dict[tuple[str, str], Row] = {}
    for row in levels:
        name = f"{row.values['factor']}={row.values['level']}"
        for effect in effects:
            if is_interaction(effect) or effect.values.get("estimate") is None:
                continue
            base = value_of(effect, "estimate_reference")
            values: dict[str, Any] = {"k": None}
            if name == level_text(effect):
                ends = interval_of(effect)
                ci = ends and tuple(base + end for end in ends)
                values |= {"value": effect.values["estimate"], "ci": ci}
            elif name == f"{effect.values['factor']}={_reference(effect)}":
                values |= {"value": base, "ci": None}
            else:
                continue
            adjusted[row.id, number(values["value"])] = replace(
                row, values={**row.values, **values}
            )
    return [*adjusted.values()]


def _reference(row: Row) -> str:
    """Return the reference of an effect, marked as its level is."""
    mark = " [scripted]"
    return f"{row.values['reference']}{mark * str(row.values['level']).endswith(mark)}"


def _changes(
    rows: Sequence[Row], sides: dict[str, Row], primary: str, words: dict[str, str]
) -> list[Change]:
    """Return the effects with both sides of each; effects on one measure share an axis.

    ``words`` has those of levels, of which it is said once.
    """
    ends = ends_of(rows)
    return [_change(row, sides, ends[metric_of(row)], primary, words) for row in rows]


def _change(
    row: Row, sides: dict[str, Row], end: float, primary: str, words: dict[str, str]
) -> Change:
    of, base, metric = row.values["level"], row.values["reference"], metric_of(row)
    factor = str(row.values["factor"])
    is_own = metric == primary
    reference, level = (
        None
        if is_interaction(row)
        else _side(
            Side(unbroken(estimate_text(row, name)), called(factor, side) if is_own else str(side)),
            sides.get(f"{factor}={side}"),
            is_own,
            metric,
        )
        for name, side in (("estimate_reference", _reference(row)), ("estimate", of))
    )
    detail = ""
    if is_interaction(row):  # whose id has the level of the second factor, too
        first, second = factor.split(TIMES)
        level_name, at = str(of).split(TIMES)
        otherwise = str(base).split(TIMES)[1]
        detail = (
            f"effect of {first}={level_name} with {second}={at}, less that with "
            f"{second}={otherwise}"
        )
    detail = detail or (called(factor, of) if is_own else f"{factor}: {called(factor, of)}")
    if of_level := words.get(level_text(row).removesuffix(" [scripted]")):
        detail += f": {of_level}"
    return Change(
        capital(factor) if is_own else capital(name_of(row)),
        detail,
        reference,
        level,
        f"{difference_text(row)} {unit_of(row)}",
        interval_text(row),
        p_value(value_of(row, "p_corrected")),
        is_shown(row),
        difference_mark(row, end),
        f"{amount(row, end)} {unit_of(row)}",
        row.id,
    )


def _side(side: Side, counts: Row | None, is_own: bool, metric: str) -> Side:
    """Return one side of an effect, with its counts by a row of ``levels``."""
    columns = ("k", "n") if is_own else ("crashed", "ended")
    if counts is None or not (is_own or metric == COLLISIONS.name):
        return side
    values: Any = counts.values
    k, n = (values[column] for column in columns)
    halves = ""
    if k is None and metric == LEFT_FIRST.name and values["value"] is not None:
        halves = f"{round(values['value'] * n / 50) / 2:g}"
    return replace(side, k=k, n=n, halves=halves, row=counts.id, columns=columns)


def _untested(primary: Sequence[Row]) -> set[str]:
    """Return the factors whose levels all have the same trials as their reference."""
    tested = [row for row in primary if not is_copied(row)]
    return {*factors_named(primary)} - {*factors_named(tested)}


def _crossing_of(levels: Sequence[Row]) -> str:
    """Return ``In combination: hurry, persona``."""
    crossed = [str(row.values["factor"]) for row in levels if len(factors_of(row)) > 1]
    return f"In combination: {', '.join(crossed[0].split(TIMES))}" if crossed else ""


def _counted(levels: Sequence[Row], metric: str, effects: Sequence[Row]) -> str:
    """Return how many trials the measure counts, as in ``58 finished trials, 12 with a crash``.

    Trials of equal drivers, words and course are one: ``80 identical to another one are left out``,
    with the levels that change nothing.
    """
    counted, ended = (sum(count_of(row, name) for row in levels) for name in ("n", "ended"))
    repeated = sum(count_of(row, "repeated") for row in levels)
    copied = joined([level_text(row) for row in effects if is_copied(row)] or [""])
    why = f" ({copied} changes nothing)" if copied else ""
    left_out = f"; {repeated:,} identical to another one{why} are left out" if repeated else ""
    crashed = sum(count_of(row, "crashed") for row in levels)
    if metric != LEFT_FIRST.name:
        what = "that ended" if metric == COLLISIONS.name else "that count"
        return f"{counted:,} trials {what}{left_out}"
    others = {"with a crash": crashed, "out of time": ended - counted - crashed}
    parts = [f", {count:,} {what}" for what, count in others.items() if count]
    return f"{counted:,} finished trials{''.join(parts)}{left_out}"


def _of_one_factor(levels: Sequence[Row], drivers: Sequence[str]) -> list[Row]:
    """Return the rows of the first drawn factor's levels, of all ``drivers``: every trial once."""
    drawn = [
        row
        for row in levels
        if row.values["factor"] != MODEL and (row.values["driver"] or "") in (drivers or [""])
    ]
    return [row for row in drawn if row.values["factor"] == drawn[0].values["factor"]]
