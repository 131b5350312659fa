"""The answer to a study's own question, as the first page and the report show it.

Nothing here is tested or estimated: sentences, rows and charts are of the finished tables
``effects`` and ``levels``. No sentence claims a direction that a corrected p does not carry.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

from merge_runner.prompts.blocks import title_of
from merge_runner.study.arms import MODEL, OPPONENT, PROMPT, SELF
from merge_runner_analysis.metrics import COLLISIONS, GAP, LEFT_FIRST, RMSE
from merge_runner_analysis.tables.model import Row, Table
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
    is_constant,
    is_copied,
    is_interaction,
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
    CHANGED,
    CORRECTED,
    EGO,
    ENOUGH,
    FEW,
    LEFT,
    METRIC_NAMES,
    PLANTED,
    SAME_TRIALS,
    TIMES,
    UNREADABLE,
    WORDS,
    capital,
    joined,
    number,
    p_value,
)

# Reason for equal trials at both levels with a mock model.
UNREAD = "not tested: the mock model does not read it"
SEEN = (COLLISIONS.name, GAP.name, RMSE.name)  # the most visible measures, in this order


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
    # A driver that is not judged has a row without values.
    known = [row for row in levels.rows if row.values.get("factor")]
    sides = {row.id: row for row in known}
    who = next((note for note in levels.notes if note.startswith((LEFT[1], EGO[1]))), "")
    planted = next((note for note in effects.notes if note.startswith(PLANTED)), "")
    driver, _ = LEFT if who == LEFT[1] else EGO
    claim, rest = answered(effects.rows, driver, planted)
    if not claim:
        return None
    asked = [row for row in effects.rows if row.values.get("primary")]
    primary = min(asked, key=lambda row: value_of(row, "p") if is_tested(row) else 1.0)
    metric = metric_of(primary)
    of_metric = [row for row in effects.rows if metric_of(row) == metric]
    named = {LEFT_FIRST.name, COLLISIONS.name, GAP.name, RMSE.name}
    others = [
        row
        for row in effects.rows
        if metric_of(row) in named - {metric} and not is_interaction(row) and is_tested(row)
        and row.values["factor"] != MODEL and not is_constant(row)
    ]  # fmt: skip
    drivers = list(
        dict.fromkeys(str(row.values["driver"]) for row in known if row.values["driver"])
    )
    short = short_names(drivers)
    drawn = drivers if len(drivers) <= len(SHAPES) else []
    shapes = dict(zip(drawn, SHAPES, strict=False))
    shown = [row for row in known if not _untested(effects.rows) & factors_of(row)]
    tested = [row for row in of_metric if is_tested(row)]
    single = [row for row in shown if len(factors_of(row)) == 1]
    if is_adjusted := len(drawn) < 2:
        single = _adjusted(single, of_metric)
    words = dict(
        note.removeprefix(WORDS).split(": ", 1) for note in effects.notes if note.startswith(WORDS)
    )
    charts = [
        level_chart("By factor", single, shapes, metric),
        level_chart(
            _crossing_of(shown), [r for r in shown if len(factors_of(r)) > 1], shapes, metric
        ),
    ]
    names = _factors(asked)
    return Answer(
        f"{'Does' if len(names) == 1 else 'Do'} {joined(names)} change {_changed(primary)}?",
        unbroken(claim),
        unbroken(rest),
        capital(name_of(primary)),
        any(end < 0 or end > 100 for row in single for end in interval_of(row) or ())
        and metric.endswith("_percent"),
        [(short[driver], shape) for driver, shape in shapes.items()],
        _counted(_of_one_factor(shown, drawn), metric, effects.rows),
        capital(who),
        next((note for note in effects.notes if note.startswith(CORRECTED)), ""),
        [chart for chart in charts if chart],
        is_adjusted,
        OPPONENT if OPPONENT in names[1:] else names[-1] if len(names) > 1 else "",
        unbroken(_interactions(tested, {str(row.values["factor"]) for row in known})),
        _changes(tested, sides, metric, words),
        _changes(others, sides, metric, {}),
        unbroken(_could([*tested, *others])),
        next((note for note in effects.notes if note.startswith(UNREADABLE)), ""),
    )


def answered(rows: Sequence[Row], driver: str = EGO[0], planted: str = "") -> tuple[str, str]:
    """Return the answer in a sentence, and the rest; empty where no primary test was made.

    The ``driver`` is the one whose going first is counted, and ``planted`` names planted effects.
    The claim is the surest of the primary tests whose corrected p is below 5 %; where there is
    none it says so, and the rest what could have been seen. It is of mock models only where there
    is no other driver, and then says so.
    """
    # Where models alone vary, their comparison answers.
    rows = [row for row in rows if not (row.values["factor"] == MODEL and row.values["primary"])]
    unscripted = [row for row in rows if not row.values.get("drivers")]
    rehearsed = "" if unscripted else "In a rehearsal with a mock model, "
    rows = unscripted or rows
    tested = [row for row in rows if is_tested(row)]
    primary = sorted(
        (row for row in tested if row.values.get("primary")), key=lambda row: value_of(row, "p")
    )
    why = UNREAD if rehearsed else SAME_TRIALS
    copied = [f"{level_text(row)} is {why}" for row in rows if is_copied(row)]
    notes = [f"{capital(planted)}."] if rehearsed and planted else []
    if not primary:
        return capital(rehearsed + f"{'; '.join(copied)}.") if copied else "", ""
    what = _changed(primary[0])
    if few := [
        row for row in primary if min(count_of(row, "n"), count_of(row, "n_reference")) < ENOUGH
    ]:
        counts = sorted(count_of(row, name) for row in few for name in ("n", "n_reference"))
        trials = " to ".join(dict.fromkeys(map(str, (counts[0], counts[-1]))))
        asked = f"whether {joined(_factors(few))} changes {what}"
        return capital(f"{rehearsed}too few trials to say {asked}: {trials} a level."), ""
    sure = [row for row in primary if is_shown(row)]
    rest = []
    if sure:
        first = sure[0]
        claim = f"{rehearsed}{first.values['factor']} changes {what}: {_both(first, driver)}."
        shown = test_text(first).replace("], ", "] (95 % interval), ")
        rest.append(f"The difference is {shown}.")
    else:
        claim = f"{rehearsed}no change of {what} is shown by {joined(_factors(primary))}."
    rest += [f"{capital(level_text(row))} changes it, too: {test_text(row)}." for row in sure[1:]]
    unshown = [row for row in primary if row not in sure]
    rest += _not_shown(unshown)
    rest += [f"{capital(text)}." for text in copied]
    if not sure:
        rest.append(_seen(primary))
    crossed = [
        row for row in tested if is_interaction(row) and metric_of(row) == metric_of(primary[0])
    ]
    rest += [f"{_named(row)} interact: {test_text(row)}." for row in crossed if is_shown(row)]
    also = [
        row
        for row in tested
        if is_shown(row) and not is_interaction(row) and row not in primary
        and row.values["factor"] != MODEL and metric_of(row) in METRIC_NAMES
    ]  # fmt: skip
    also.sort(key=lambda row: (_seen_first(row), value_of(row, "p")))
    rest += [
        f"{capital(str(row.values['factor']))} changes {_changed(row)}: {_both(row, driver)}."
        for row in [row for row in also if metric_of(row) in SEEN][:FEW] or also[: not sure]
    ]
    return capital(claim), " ".join(filter(None, [*rest, *notes]))


def _seen_first(row: Row) -> int:
    """Return the rank of an effect's measure: the most visible one is the first."""
    return SEEN.index(metric_of(row)) if metric_of(row) in SEEN else len(SEEN)


def _not_shown(rows: Sequence[Row]) -> Iterator[str]:
    """Yield sentences on primary tests without an effect; of more than FEW the first alone."""
    if len(rows) > FEW:
        yield (
            f"{len(rows)} levels are not shown to change it; {level_text(rows[0])} comes nearest: "
            f"{test_text(rows[0])}."
        )
        return
    for row in rows:
        yield f"{capital(level_text(row))} is not shown to change it: {test_text(row)}."


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
    sizes = {name: _sizes([row for row in rows if name_of(row) == name]) for name in names}
    return "; ".join(f"{name} {size}" for name, size in sizes.items() if size)


def _seen(rows: Sequence[Row]) -> str:
    """Return the minimum detectable effects in a sentence."""
    sizes = _sizes(rows)
    return f"The study had 80 % power for an effect of {sizes}." if sizes else ""


def _sizes(rows: Sequence[Row]) -> str:
    """Return the detectable effect of each factor, or only the largest of more than FEW factors.

    A factor with several levels has its largest one.
    """
    least: dict[str, Row] = {}
    for row in rows:
        factor = str(row.values["factor"])
        if row.values.get("detectable") is not None:
            known = [row, *filter(None, [least.get(factor)])]
            least[factor] = max(known, key=lambda row: value_of(row, "detectable"))
    if not least:
        return ""
    if len(least) > FEW:
        factor = max(least, key=lambda name: value_of(least[name], "detectable"))
        least = {"any factor": least[factor]}
    first, *others = (
        (amount(row, value_of(row, "detectable")), f" ({factor})") for factor, row in least.items()
    )
    unit = unit_of(rows[0])
    return ", ".join([f"{first[0]} {unit}{first[1] * bool(others)}", *map("".join, others)])


def _factors(rows: Iterable[Row]) -> list[str]:
    return list(dict.fromkeys(str(row.values["factor"]) for row in rows))


def _both(row: Row, driver: str) -> str:
    """Return ``in the same situations, the left driver goes first in 63.00 % with hurry=yes``."""
    factor, level, base = (row.values[name] for name in ("factor", "level", "reference"))
    of, reference = (estimate_text(row, name) for name in ("estimate", "estimate_reference"))
    if metric_of(row) == LEFT_FIRST.name:
        return (
            f"in the same situations and without a crash, {driver} goes first in {of} with "
            f"{factor}={level} and in {reference} with {factor}={_called(factor, base)}"
        )
    return f"{of} with {factor}={level}, {reference} with {factor}={_called(factor, base)}"


def _called(factor: object, level: object) -> str:
    """Return a level as a page names it: ``self`` is another copy of the same driver."""
    if factor == OPPONENT and level == SELF:
        return f"{SELF} (another copy of the same driver)"
    return title_of(str(level)) if factor == PROMPT else str(level)


def _changed(row: Row) -> str:
    """Return an effect's measure as a claim names it: ``who goes first``."""
    return CHANGED.get(metric_of(row), name_of(row))


def _named(row: Row) -> str:
    return capital(str(row.values["factor"]).replace(TIMES, " and "))


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
            Side(
                unbroken(estimate_text(row, name)), _called(factor, side) if is_own else str(side)
            ),
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
    detail = detail or (_called(factor, of) if is_own else f"{factor}: {_called(factor, of)}")
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


def _untested(effects: Sequence[Row]) -> set[str]:
    """Return the factors whose levels all have the same trials as their reference."""
    asked = [row for row in effects if row.values.get("primary")]
    return {*_factors(asked)} - {*_factors(row for row in asked if not is_copied(row))}


def _crossing_of(levels: Sequence[Row]) -> str:
    """Return ``In combination: hurry, persona``."""
    crossed = [str(row.values["factor"]) for row in levels if len(factors_of(row)) > 1]
    return f"In combination: {', '.join(crossed[0].split(TIMES))}" if crossed else ""


def _counted(levels: Sequence[Row], metric: str, effects: Sequence[Row]) -> str:
    """Return how many trials the measure counts, as in ``58 trials without a crash, 12 with one``.

    Trials of equal drivers, words and course are one: ``80 identical to another one are left out``,
    with the levels that change nothing.
    """
    trials = f"{sum(count_of(row, 'n') for row in levels):,} trials"
    repeated = sum(count_of(row, "repeated") for row in levels)
    copied = joined([level_text(row) for row in effects if is_copied(row)] or [""])
    why = f" ({copied} changes nothing)" if copied else ""
    left_out = f"; {repeated:,} identical to another one{why} are left out" if repeated else ""
    crashed = sum(count_of(row, "crashed") for row in levels)
    what = " that ended" if metric == COLLISIONS.name else " that count"
    if metric == LEFT_FIRST.name:
        what = f" without a crash, {crashed:,} with one" if crashed else " without a crash"
    return f"{trials}{what}{left_out}"


def _of_one_factor(levels: Sequence[Row], drivers: Sequence[str]) -> list[Row]:
    """Return the rows of the first drawn factor's levels, of all ``drivers``: every trial once."""
    drawn = [
        row
        for row in levels
        if row.values["factor"] != MODEL and (row.values["driver"] or "") in (drivers or [""])
    ]
    return [row for row in drawn if row.values["factor"] == drawn[0].values["factor"]]
