"""Words and deeds: how often drivers do what their tactical word says, and what it follows."""

from __future__ import annotations

from merge_runner_analysis.data.study import Study
from merge_runner_analysis.stats.first_action import HOLD_MPS2, Seat, seats
from merge_runner_analysis.stats.intervals import Estimate
from merge_runner_analysis.stats.words import CUES, Words
from merge_runner_analysis.stats.words import words as words_of
from merge_runner_analysis.tables.model import (
    ENDED,
    GROUP_COLUMNS,
    Column,
    Row,
    Table,
    Value,
    row_of,
)

SHARES = {
    "merge_yields": ("M", "M, yields (%)", "of these, followed by a second of yielding"),
    "yield_goes": ("Y", "Y, goes (%)", "of these, followed by a second of going"),
    "merge_second": ("M at first", "second (%)", "of these, merged second"),
    "yield_first": ("Y at first", "first (%)", "of these, merged first"),
}


def words(study: Study) -> Table:
    """A row per driver and variant that said M or Y, and for each of a mixed pair that did."""
    every = [(seat, words_of(study, seat)) for group in study.models for seat in seats(group)]
    spoken = [(seat, found) for seat, found in every if found is not None]
    judged = "judged " if study.unjudged else ""
    return Table(
        "words",
        (*GROUP_COLUMNS, *_share_columns(), *_cue_columns()),
        [_row(seat, found) for seat, found in spoken],
        (
            "going and yielding: the mean acceleration of the second after the decision is above "
            f"{HOLD_MPS2} or below -{HOLD_MPS2} m/s²; decisions whose trial ends within it do not "
            "count. At first: the word of the first decision, in trials that finished",
            "the first word: Firth's logit of M on own projected headway (m) and own relative "
            "velocity (m/s), with penalised likelihood ratios; both drivers of a trial count, "
            "since neither knows the other's first word. It follows what has p < .05",
            *([] if spoken else [f"no {judged}driver said a tactical word"]),
        ),
    )


def _share_columns() -> list[Column]:
    columns = []
    for name, (n, heading, meaning) in SHARES.items():
        columns += [
            Column(f"{name}_n", n, "count", 0, f"decisions with {n}"),
            Column(f"{name}_percent", heading, "percent", 1, meaning, optional=True),
            Column(f"{name}_ci", "95 % CI", "interval", 1, "Wilson's", optional=True),
        ]
    return columns


def _cue_columns() -> list[Column]:
    columns = [Column("first_n", "first words", "count", 0, "of the drivers")]
    for term, name in CUES.items():
        columns += [
            Column(f"{term}_b", f"{name} b", "number", 2, f"of own {name}, in logits"),
            Column(f"{term}_p", "p", "p", 3, "penalised likelihood ratio"),
        ]
    return [*columns, Column("follows", "follows", meaning="what the first word follows")]


def _row(seat: Seat, found: Words) -> Row:
    cells: dict[str, Value] = {
        "driver": seat.name,
        "first_n": found.first.n,
        "follows": found.follows,
    }
    for name in SHARES:
        share: Estimate = getattr(found, name)
        cells[f"{name}_n"] = share.n
        cells[f"{name}_percent"] = None if share.value is None else 100 * share.value
        cells[f"{name}_ci"] = share.bounds(100)
    for name, term in found.first.terms.items():
        if name in CUES:
            cells |= {f"{name}_b": term.b, f"{name}_p": term.p}
    note = f"the first word: {found.first.problem}" if found.first.problem else ""
    return row_of(seat.group, cells, note, item=seat.side, counts=ENDED)
