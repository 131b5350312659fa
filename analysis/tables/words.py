"""Words and deeds: whether M (merge first) and Y (yield) are followed by what they say.

A word is followed by going, or by yielding, where the mean acceleration of the next second is above
or below 0.2 m/s² either way, as of first actions.
"""

from __future__ import annotations

import pandas as pd

from merge_runner.records import SIDES
from merge_runner_analysis.data.study import Study, of_trials
from merge_runner_analysis.stats.first_action import HOLD_MPS2, Seat, seats
from merge_runner_analysis.stats.intervals import Estimate, proportion
from merge_runner_analysis.tables.model import (
    ENDED,
    GROUP_COLUMNS,
    Column,
    Optional,
    Row,
    Table,
    Value,
    interval,
    row_of,
)

# One row a decision with a tactical word: whether it is its driver's first, and the mean
# acceleration of the second that follows it, NULL where the trial ends before.
WORDS = """
WITH speeds AS (
    SELECT trial_id, spec_hash, side, round(time_s, 3)::DECIMAL(9, 3) AS time_s, velocity_mps
    FROM states WHERE time_s >= 0
), said AS (
    SELECT trial_id, spec_hash, side, decision, tactical, round(time_s, 3)::DECIMAL(9, 3) AS time_s,
        decision = min(decision) OVER (PARTITION BY trial_id, spec_hash, side) AS at_first
    FROM decisions QUALIFY tactical IS NOT NULL
)
SELECT said.* EXCLUDE (time_s) REPLACE (if(said.side = ego, 'left', 'right') AS side),
    later.velocity_mps - now.velocity_mps AS driven_mps2
FROM said JOIN speeds AS now USING (trial_id, spec_hash, side, time_s)
JOIN trial_drivers USING (trial_id, spec_hash)
LEFT JOIN speeds AS later ON later.trial_id = said.trial_id AND later.spec_hash = said.spec_hash
    AND later.side = said.side AND later.time_s = said.time_s + 1
ORDER BY ALL
"""
SHARES = {
    "merge_yields": ("M", "M, yields (%)", "of these, followed by a second of yielding"),
    "yield_goes": ("Y", "Y, goes (%)", "of these, followed by a second of going"),
    "merge_second": ("M at first", "second (%)", "of these, merged second"),
    "yield_first": ("Y at first", "first (%)", "of these, merged first"),
}


def words(study: Study) -> Table:
    """A row per driver and variant that said M or Y, and for each of a mixed pair that did."""
    every = [seat for group in study.models for seat in seats(group)]
    rows = [_row(seat, said) for seat in every if not (said := _said(study, seat)).empty]
    columns = [
        column
        for name, (n, heading, meaning) in SHARES.items()
        for column in (
            Column(f"{name}_n", n, "count", 0, f"decisions with {n}"),
            Optional(f"{name}_percent", heading, "percent", 1, meaning),
            interval(f"{name}_ci", "Wilson's", 1),
        )
    ]
    judged = "judged " if study.unjudged else ""
    return Table(
        "words",
        (*GROUP_COLUMNS, *columns),
        rows,
        (
            "going and yielding: the mean acceleration of the second after the decision is above "
            f"{HOLD_MPS2} or below -{HOLD_MPS2} m/s²; decisions whose trial ends within it do not "
            "count. At first: the word of the first decision, in trials that finished",
            *([] if rows else [f"no {judged}driver said a tactical word"]),
        ),
    )


def _said(study: Study, seat: Seat) -> pd.DataFrame:
    """The words of a driver in the trials that ended, one row each."""
    trials = seat.group.ended[["trial_id", "spec_hash", "status", "merged_first"]]
    said = of_trials(study.read(WORDS), trials).merge(trials, on=["trial_id", "spec_hash"])
    return said[said["side"].isin([SIDES[place] for place in seat.sides])]


def _row(seat: Seat, said: pd.DataFrame) -> Row:
    merges, yields = (said[said["tactical"] == word]["driven_mps2"].dropna() for word in "MY")
    over = said[said["at_first"] & (said["status"] == "finished") & said["merged_first"].notna()]
    won, first = over["side"] == over["merged_first"], over["tactical"]
    values: dict[str, Value] = {"driver": seat.name}
    for name, found in (
        ("merge_yields", merges < -HOLD_MPS2),
        ("yield_goes", yields > HOLD_MPS2),
        ("merge_second", ~won[first == "M"]),
        ("yield_first", won[first == "Y"]),
    ):
        share: Estimate = proportion(int(found.sum()), len(found))
        values[f"{name}_n"] = share.n
        values[f"{name}_percent"] = None if share.value is None else 100 * share.value
        values[f"{name}_ci"] = share.bounds(100)
    return row_of(seat.group, values, item=seat.side, counts=ENDED)
