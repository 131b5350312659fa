"""The answer to a study's own question, as the first page and the report show it.

Nothing here is tested or estimated: sentences, rows and charts are of the finished tables
``effects`` and ``levels``. No sentence claims a direction that a corrected p does not carry.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from merge_runner.study.arms import MODEL, OPPONENT
from merge_runner_analysis.metrics import COLLISIONS, LEFT_FIRST
from merge_runner_analysis.tables.model import Table
from merge_runner_analysis.web.claims import SEEN, answered, called, changed, factors_named, sizes
from merge_runner_analysis.web.effect_rows import (
    Measured,
    difference_mark,
    ends_of,
    estimate_text,
    is_copied,
    is_tested,
    rows_of,
    unbroken,
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
    rows, who = rows_of(effects), _note(levels, LEFT[1]) or _note(levels, EGO[1])
    driver, _ = LEFT if who == LEFT[1] else EGO
    claim, rest = answered(effects.rows, driver, _note(effects, PLANTED))
    if not claim:
        return None
    # A driver that is not judged has a row without values.
    known = [row for row in rows_of(levels) if row.values.get("factor")]
    asked = [row for row in rows if row.values.get("primary")]
    primary = min(asked, key=lambda row: row.values["p"] if is_tested(row) else 1.0)
    metric, names = primary.metric, factors_named(asked)
    of_metric = [row for row in rows if row.metric == metric]
    tested = [row for row in of_metric if is_tested(row)]
    others = [row for row in rows if _is_other(row, metric)]
    shapes = _shapes(known)
    short = short_names([*shapes])
    tested_factors = factors_named(row for row in asked if not is_copied(row))
    untested = {*names} - {*tested_factors}
    shown = [row for row in known if untested.isdisjoint(row.factors)]
    single = [row for row in shown if len(row.factors) == 1]
    if is_adjusted := len(shapes) < 2:
        single = _adjusted(single, of_metric)
    crossed = [row for row in shown if len(row.factors) > 1]
    crossing = ", ".join(crossed[0].factors) if crossed else ""
    charts = [
        level_chart("By factor", single, shapes, metric),
        level_chart(f"In combination: {crossing}", crossed, shapes, metric),
    ]
    sides = {row.id: row for row in known}
    return Answer(
        f"{'Does' if len(names) == 1 else 'Do'} {joined(names)} change {changed(primary)}?",
        unbroken(claim),
        unbroken(rest),
        capital(primary.name),
        any(end < 0 or end > 100 for row in single for end in row.values.get("ci") or ())
        and metric.endswith("_percent"),
        [(short[driver], shape) for driver, shape in shapes.items()],
        _counted(_of_one_factor(shown, [*shapes]), metric, rows),
        capital(who),
        _note(effects, CORRECTED),
        [chart for chart in charts if chart],
        is_adjusted,
        (OPPONENT if OPPONENT in names else names[-1]) if len(names) > 1 else "",
        unbroken(_interactions(tested, known)),
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


def _is_other(row: Measured, metric: str) -> bool:
    """Return whether an effect is shown besides those on the study's ``metric``."""
    shares = {row.values.get(name) for name in ("estimate", "estimate_reference")}
    return (
        row.metric in {LEFT_FIRST.name, *SEEN} - {metric}
        and not row.is_interaction
        and is_tested(row)
        and row.values["factor"] != MODEL
        # A share that is 0 % at both levels, or 100 %, is no news.
        and not (row.unit == "points" and shares in ({0.0}, {100.0}))
    )


def _shapes(levels: Sequence[Measured]) -> dict[str, str]:
    """Return the shape of each driver in charts; empty where there are too many."""
    drivers = dict.fromkeys(row.values["driver"] for row in levels if row.values["driver"])
    return dict(zip(drivers, SHAPES, strict=False)) if len(drivers) <= len(SHAPES) else {}


def _interactions(rows: Sequence[Measured], drawn: Sequence[Measured]) -> str:
    """Describe the interactions of factors whose combinations are drawn."""
    crossed = {name for row in drawn if len(row.factors) > 1 for name in row.factors}
    texts = []
    for row in rows:
        if row.is_interaction and crossed.issuperset(row.factors):
            what = "they interact" if row.is_shown else "no interaction is shown"
            texts.append(f"{row.values['factor']}: {what}, {row.test}.")
    return " ".join(texts)


def _could(rows: Sequence[Measured]) -> str:
    """Return the minimum detectable effects by measure: ``goes first 4.26 points (hurry)``."""
    names = dict.fromkeys(row.name for row in rows)
    least = {name: sizes([row for row in rows if row.name == name]) for name in names}
    return "; ".join(f"{name} {size}" for name, size in least.items() if size)


def _adjusted(levels: Sequence[Measured], effects: Sequence[Measured]) -> list[Measured]:
    """Return levels with their values in the effects; the interval is that of the difference.

    A reference has a row for each value that it has beside other levels, and no interval.
    """
    adjusted: dict[tuple[str, str], Measured] = {}
    for row in levels:
        for effect in effects:
            value, base = (effect.values.get(f"estimate{of}") for of in ("", "_reference"))
            ends = effect.values.get("ci")
            if effect.is_interaction or value is None:
                continue
            if row.level == effect.level:
                ci = ends and tuple(base + end for end in ends)
            elif row.level == f"{effect.values['factor']}={_reference(effect)}":
                value, ci = base, None
            else:
                continue
            values = {**row.values, "k": None, "value": value, "ci": ci}
            adjusted[row.id, number(value)] = replace(row, values=values)
    return [*adjusted.values()]


def _reference(row: Measured) -> str:
    """Return the reference of an effect, marked as its level is."""
    mark = " [scripted]"
    return f"{row.values['reference']}{mark * str(row.values['level']).endswith(mark)}"


def _changes(
    rows: Sequence[Measured], sides: dict[str, Measured], primary: str, words: dict[str, str]
) -> list[Change]:
    """Return the effects with both sides of each; effects on one measure share an axis.

    ``words`` has those of levels, of which it is said once.
    """
    ends = ends_of(rows)
    return [_change(row, sides, ends[row.metric], primary, words) for row in rows]


def _change(
    row: Measured, sides: dict[str, Measured], end: float, primary: str, words: dict[str, str]
) -> Change:
    factor, of, base = (row.values[name] for name in ("factor", "level", "reference"))
    is_own, reference, level = row.metric == primary, None, None
    if row.is_interaction:  # whose id has the level of the second factor, too
        first, second = row.factors
        level_name, at = of.split(TIMES)
        otherwise = base.split(TIMES)[1]
        detail = (
            f"effect of {first}={level_name} with {second}={at}, less that with "
            f"{second}={otherwise}"
        )
    else:
        reference, level = (
            _side(row, name, side, sides.get(f"{factor}={side}"), is_own)
            for name, side in (("estimate_reference", _reference(row)), ("estimate", of))
        )
        detail = called(factor, of) if is_own else f"{factor}: {called(factor, of)}"
    if of_level := words.get(row.level.removesuffix(" [scripted]")):
        detail += f": {of_level}"
    return Change(
        capital(factor if is_own else row.name),
        detail,
        reference,
        level,
        row.difference,
        row.interval,
        p_value(row.values["p_corrected"]),
        row.is_shown,
        difference_mark(row, end),
        row.with_unit(end),
        row.id,
    )


def _side(row: Measured, name: str, level: str, counts: Measured | None, is_own: bool) -> Side:
    """Return one side of an effect, with its counts by a row of ``levels``."""
    text = unbroken(estimate_text(row, name))
    label = called(row.values["factor"], level) if is_own else level
    if counts is None or not (is_own or row.metric == COLLISIONS.name):
        return Side(text, label)
    columns = ("k", "n") if is_own else ("crashed", "ended")
    k, n, value = (counts.values[column] for column in (*columns, "value"))
    is_half = k is None and row.metric == LEFT_FIRST.name and value is not None
    halves = f"{round(value * n / 50) / 2:g}" if is_half else ""
    return Side(text, label, k, halves, n, counts.id, columns)


def _counted(levels: Sequence[Measured], metric: str, effects: Sequence[Measured]) -> str:
    """Return how many trials the measure counts, as in ``58 finished trials, 12 with a crash``.

    Trials of equal drivers, words and course are one: ``80 identical to another one are left out``,
    with the levels that change nothing.
    """
    counted, ended = (sum(row.values[name] for row in levels) for name in ("n", "ended"))
    repeated = sum(row.values["repeated"] for row in levels)
    copied = joined([row.level for row in effects if is_copied(row)] or [""])
    why = f" ({copied} changes nothing)" if copied else ""
    left_out = f"; {repeated:,} identical to another one{why} are left out" if repeated else ""
    crashed = sum(row.values["crashed"] for row in levels)
    if metric != LEFT_FIRST.name:
        what = "that ended" if metric == COLLISIONS.name else "that count"
        return f"{counted:,} trials {what}{left_out}"
    others = {"with a crash": crashed, "out of time": ended - counted - crashed}
    parts = [f", {count:,} {what}" for what, count in others.items() if count]
    return f"{counted:,} finished trials{''.join(parts)}{left_out}"


def _of_one_factor(levels: Sequence[Measured], drivers: Sequence[str]) -> list[Measured]:
    """Return the rows of the first drawn factor's levels, of all ``drivers``: every trial once."""
    drawn = [
        row
        for row in levels
        if row.values["factor"] != MODEL and (row.values["driver"] or "") in (drivers or [""])
    ]
    return [row for row in drawn if row.values["factor"] == drawn[0].values["factor"]]
