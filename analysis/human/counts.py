"""The human trials in a database, counted beside the published counts."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pandas as pd

from analysis.human.record import PAIRS
from analysis.load import load
from analysis.published import HUMAN_TRIALS, published
from merge_runner.simulator.conditions import CONDITIONS

OUTCOMES = ["left_first", "right_first", "collided"]
COUNTS = ["trials", *OUTCOMES]
HUMAN = """
SELECT pair, condition, count(*) AS trials,
    count(*) FILTER (merged_first = 'left') AS left_first,
    count(*) FILTER (merged_first = 'right') AS right_first,
    count(*) FILTER (status = 'collided') AS collided
FROM trials WHERE source = 'human' GROUP BY ALL ORDER BY ALL
"""


def human_counts(db: Path) -> pd.DataFrame:
    """One row a pair and condition, with the columns COUNTS; raises UsageError."""
    return load(HUMAN, db)


def by_pair(counts: pd.DataFrame) -> pd.DataFrame:
    """Counts of each pair."""
    return counts.groupby("pair")[COUNTS].sum()


def by_condition(counts: pd.DataFrame) -> pd.DataFrame:
    """Counts of each condition over the published pairs, with the published counts.

    Those have the suffix ``_published``.
    """
    pairs = counts[counts["pair"].isin(PAIRS.values())]
    found = pairs.groupby("condition")[COUNTS].sum().reindex(CONDITIONS, fill_value=0)
    known = (
        published("human_outcomes")
        .set_index("condition")[OUTCOMES]
        .assign(trials=lambda frame: frame.sum(axis=1))
    )
    return found.join(known, suffixes=("", "_published"))


def findings(counts: pd.DataFrame) -> Iterator[str]:
    """What to know of these trials: how many are missing, and which counts differ."""
    conditions = by_condition(counts)
    trials = conditions["trials"].sum()
    if trials < HUMAN_TRIALS:
        yield f"{trials} of {HUMAN_TRIALS} trials: the human rows of the tables come from these"
    others = sorted(set(counts["pair"]) - set(PAIRS.values()))
    if others:
        yield f"{', '.join(others)}: not of the nine published pairs, but in the tables too"
    complete = (conditions["trials"] == conditions["trials_published"]) | (trials == HUMAN_TRIALS)
    differing = [
        f"{condition} {outcome.replace('_', ' ')} {row[outcome]} instead of "
        f"{row[f'{outcome}_published']}"
        for condition, row in conditions[complete].iterrows()
        for outcome in OUTCOMES
        if row[outcome] != row[f"{outcome}_published"]
    ]
    if differing:
        yield f"the outcomes differ from the published ones: {', '.join(differing)}"
