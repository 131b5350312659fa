"""What the imported human trials are, beside the 990 that are published."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import pandas as pd

from merge_runner.scenarios.merge.conditions import HUMAN_CONDITIONS
from merge_runner_analysis.data.load import load
from merge_runner_analysis.data.reference_data import HUMAN_TRIALS, PAIRS, published

OUTCOMES = ["left_first", "right_first", "collided"]
COUNTS = ["trials", *OUTCOMES]
# What a spec says of trials that were not read from the recordings.
RECORDINGS, VELOCITY_PAGES = "recordings", "velocity pages"
TRIALS = f"""
SELECT pair, condition, status, merged_first,
    coalesce(spec->>'$.origin', '{RECORDINGS}') AS origin
FROM trials LEFT JOIN specs USING (spec_hash) WHERE source = 'human'
"""  # noqa: S608 # constants


@dataclass(frozen=True, slots=True)
class Imported:
    """Human trials that were imported.

    ``complete``: every condition has as many trials as are published, so that they can stand in
    the place of the published counts. ``contradicting`` names, in words, what no part of the
    published trials can have: then these are another data set. ``left_out`` counts the trials of
    pairs beside the published ones. ``from_pages`` of the trials are of the velocity pages, the
    others of the recordings.
    """

    trials: int
    pairs: int
    complete: bool
    contradicting: tuple[str, ...]
    left_out: dict[str, int]
    from_pages: int

    @property
    def label(self) -> str:
        """How a row of these trials is named."""
        if self.contradicting:
            return f"humans (another data set, {self.trials} trials)"
        if not self.complete:
            return f"humans ({self.trials} of {HUMAN_TRIALS} imported)"
        return "human"

    def findings(self) -> Iterator[str]:
        """What to know of these trials."""
        which = f"{self.trials} of {HUMAN_TRIALS} trials"
        if self.contradicting:
            which = f"{self.trials} trials of another data set"
            yield f"another data set than the published one: {', '.join(self.contradicting)}"
        if not self.complete:
            yield (
                f"{which}: who merged first and collisions stay the {HUMAN_TRIALS} published "
                "outcomes while a condition has fewer trials, the rest comes from these"
            )
        if self.from_pages:
            yield (
                f"{self.from_pages} of {self.trials} trials are of the public velocity pages, with "
                "positions made of the speeds; the others are of the recordings"
            )
        for pair, trials in self.left_out.items():
            yield f"{pair}: {trials} trials, not of the nine published pairs: left out"


def human_trials(db: Path) -> pd.DataFrame:
    """The human trials of a database; raises UsageError."""
    return load(TRIALS, db)


def of_published_pairs(trials: pd.DataFrame) -> pd.DataFrame:
    """The trials of the nine published pairs; all, where there is none of these."""
    own = trials["pair"].isin(PAIRS.values())
    return trials[own] if own.any() else trials


def imported(trials: pd.DataFrame) -> Imported:
    """Compare human trials, which have the columns of TRIALS, with the published counts."""
    chosen = of_published_pairs(trials)
    conditions = by_condition(trials)
    others = trials.loc[trials.index.difference(chosen.index), "pair"]
    foreign = not chosen["pair"].isin(PAIRS.values()).any()
    complete = bool((conditions["trials"] >= conditions["trials_published"]).all())
    return Imported(
        trials=len(chosen),
        pairs=chosen["pair"].nunique(),
        complete=complete and not foreign,
        contradicting=(
            ("no trial is of the nine published pairs",)
            if foreign
            else tuple(_contradicting(conditions))
        ),
        left_out={str(pair): int(n) for pair, n in others.value_counts().sort_index().items()},
        from_pages=int((chosen["origin"] == VELOCITY_PAGES).sum()),
    )


def by_pair(trials: pd.DataFrame) -> pd.DataFrame:
    """Counts of each pair, with the columns COUNTS."""
    return _counted(trials).groupby(trials["pair"]).sum()


def by_condition(trials: pd.DataFrame) -> pd.DataFrame:
    """Counts of each condition over the published pairs, with the published counts.

    Those have the suffix ``_published``.
    """
    own = trials[trials["pair"].isin(PAIRS.values())]
    found = _counted(own).groupby(own["condition"]).sum().reindex(HUMAN_CONDITIONS, fill_value=0)
    known = published("human_outcomes").set_index("condition")[OUTCOMES]
    return found.join(known.assign(trials=known.sum(axis=1)), suffixes=("", "_published"))


def _counted(trials: pd.DataFrame) -> pd.DataFrame:
    return pd.DataFrame(
        {
            "trials": 1,
            "left_first": trials["merged_first"] == "left",
            "right_first": trials["merged_first"] == "right",
            "collided": trials["status"] == "collided",
        },
        index=trials.index,
    ).astype(int)


def _contradicting(conditions: pd.DataFrame) -> Iterator[str]:
    """More of an outcome than is published, or another number of it in a whole condition."""
    for condition, row in conditions.iterrows():
        whole = row["trials"] >= row["trials_published"]
        for outcome in OUTCOMES:
            known = row[f"{outcome}_published"]
            if row[outcome] > known or (whole and row[outcome] != known):
                yield f"{condition} {outcome.replace('_', ' ')} {row[outcome]} instead of {known}"
