"""What drivers say and do first by headway and relative velocity, where they were only asked."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import pandas as pd

from analysis.data.first_looks import POINT, FirstLooks, first_looks
from analysis.data.reference_data import citation
from analysis.data.study import HUMAN, Study
from analysis.stats.exchange import Exchange, of_humans, weighed
from analysis.stats.first_look import published_humans
from analysis.stats.intervals import Estimate, mean, proportion
from analysis.tables.model import GROUP_COLUMNS, Column, Row, Table, Value
from merge_runner.text_safety import quoted

ACTIONS = "human_first_actions"
NOTES = (
    "at: the driver's own projected headway in m and own relative velocity in m/s, own minus "
    "other; both sides are pooled",
    "M: share of M with Wilson's interval; action: mean with Student's t. Slopes: of a logit of M "
    "(log-odds), and of the first action by least squares (m/s^2), errors clustered by trial. "
    "Exchange rate: minus the slope on velocity by that on headway, with Fieller's interval: so "
    "much headway makes up for 1 m/s more",
    f"human: exchange rate by who merged first, left minus right: {citation('human_outcomes')}. "
    f"Slope of the first action by velocity alone, not at equal headway: {citation(ACTIONS)}",
)
HEADWAY, VELOCITY, RATE = "per m of headway", "per m/s of velocity", "exchange rate (m per m/s)"


def first_look_surface(study: Study) -> Table:
    """A row per driver, prompt and point, and for each the slopes and the exchange rate."""
    found = first_looks(study)
    human = [_human_slope(), _human()] if study.human in study.groups else []
    return Table(
        "first-look-surface",
        "First situations asked without the loop, by headway and relative velocity",
        (
            *GROUP_COLUMNS,
            Column("at", "at"),
            Column("asked", "asked", "count", 0, "answers"),
            Column("invalid", "invalid", "count", 0, "answers without a valid plan", optional=True),
            Column("m", "M", "number", 2, "share of M among answers with a word", optional=True),
            Column("m_ci", "95 % CI", "interval", 2, "of M", optional=True),
            Column(
                "action", "first action", "number", 3,
                "mean net acceleration over the first step, in m/s^2, of valid answers",
                optional=True,
            ),
            Column("action_ci", "95 % CI", "interval", 3, "of the first action", optional=True),
            Column(
                "mean", "first second", "number", 3,
                "mean net acceleration over the first second, in m/s^2, of valid answers; empty "
                "where the next decision comes sooner",
                optional=True,
            ),
        ),
        [*human, *(row for looks in found for row in _rows(looks))],
        (*NOTES, *_remarks(found)),
    )  # fmt: skip


def _rows(looks: FirstLooks) -> Iterator[Row]:
    for (headway_m, velocity_mps), rows in looks.rows.groupby(POINT):
        yield _point(looks, f"h={headway_m:+g} dv={velocity_mps:+g}", rows)
    words, actions = weighed(looks)
    for at, m, action in (
        (HEADWAY, words.headway, actions.headway),
        (VELOCITY, words.velocity, actions.velocity),
        (RATE, _rate(words), _rate(actions)),
    ):
        if m is not None or action is not None:
            yield _row(looks, at, len(looks.rows), m, action)


def _remarks(found: Sequence[FirstLooks]) -> Iterator[str]:
    """What is to be known of the slopes, or why there are none."""
    if not found:
        yield "no driver was only asked; `merge-runner seat first` asks, --grid at more points"
    for looks in found:
        for what, fit in zip(("M", "first action"), weighed(looks), strict=True):
            # A program has no word, and without chance there is no interval to lack an end.
            for remark in (fit.remark, fit.unbounded if looks.sampled else ""):
                if remark and fit.n:
                    yield f"{looks.id}: {what}: {remark}"
        if not looks.sampled:
            yield f"{looks.id}: it declares no chance: each answer counts once, with no interval"


def _rate(found: Exchange) -> Estimate | None:
    low, high = found.bounds or (None, None)
    return None if found.rate is None else Estimate(found.rate, low, high, found.n)


def _point(looks: FirstLooks, at: str, rows: pd.DataFrame) -> Row:
    valid, words = rows[rows["valid"]], rows["tactical"].dropna()
    m = proportion(int((words == "M").sum()), len(words))
    headway_m, velocity_mps = map(float, rows[POINT].iloc[0])
    driven = mean(valid["mean_mps2"].dropna().to_numpy(float))
    return _row(
        looks,
        at,
        len(rows),
        m,
        mean(valid["action_mps2"].to_numpy(float)),
        {"invalid": len(rows) - len(valid), "mean": driven.value},
        where=f" AND own * projected_headway_m = {headway_m}"
        f" AND own * relative_velocity_mps = {velocity_mps}",
    )


def _row(
    looks: FirstLooks,
    at: str,
    asked: int,
    m: Estimate | None,
    action: Estimate | None,
    more: dict[str, Value] | None = None,
    *,
    where: str = "",
) -> Row:
    return Row(
        f"{looks.id}/{at}",
        (looks.id,),
        {"driver": looks.label, "setting": looks.setting, "at": at, "asked": asked,
         **_cells("m", m, sampled=looks.sampled), **_cells("action", action, sampled=looks.sampled),
         **(more or {})},
        query=_query(looks, where),
    )  # fmt: skip


def _cells(name: str, found: Estimate | None, *, sampled: bool) -> dict[str, Value]:
    if found is None:
        return {}
    return {name: found.value, **({f"{name}_ci": found.bounds()} if sampled else {})}


def _query(looks: FirstLooks, where: str) -> str:
    """The query that lists the answers behind a row."""
    specs = ", ".join(map(quoted, looks.spec_hashes))
    return (
        "SELECT trial_id, side, tactical, valid, failure, plan FROM trials JOIN "  # noqa: S608 # ours
        "(SELECT *, if(side = 'left', 1, -1) AS own FROM decisions WHERE decision = 0) "
        "USING (trial_id, spec_hash) WHERE source = 'seat' AND status <> 'failed' AND spec_hash IN "
        f"({specs}) AND variant = {quoted(looks.setting)} AND "
        f"if(side = 'left', model_left, model_right) = {quoted(looks.model)}{where} ORDER BY ALL"
    )


def _human_slope() -> Row:
    """The published slope of the first action, on the own relative velocity alone."""
    known = published_humans()
    low, high = known.slope.bounds() or (None, None)
    slope = Estimate(known.slope.value, low, high, sum(known.n.values()))
    values: dict[str, Value] = {"driver": HUMAN, "setting": "", "at": VELOCITY, "asked": slope.n}
    values |= _cells("action", slope, sampled=True)
    return Row(f"{HUMAN}/{VELOCITY}", (HUMAN,), values, published=tuple(values), cited=ACTIONS)


def _human() -> Row:
    found = of_humans()
    values: dict[str, Value] = {"driver": HUMAN, "setting": "", "at": RATE, "asked": found.n}
    values |= _cells("m", _rate(found), sampled=True)
    return Row(f"{HUMAN}/{RATE}", (HUMAN,), values, published=tuple(values), cited="human_outcomes")
