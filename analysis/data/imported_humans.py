"""The imported human trials beside the 990 published ones."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import pandas as pd

from merge_runner.scenarios.merge.conditions import HUMAN_CONDITIONS
from merge_runner_analysis.data.load import load
from merge_runner_analysis.data.reference_data import HUMAN_TRIALS, PAIRS, published

OUTCOMES = ["left_first", "right_first", "collided"]
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
    known = published("human_outcomes").set_index("condition")[OUTCOMES]
    whole = conditions["trials"] >= known.sum(axis=1)
    if chosen["pair"].isin(PAIRS.values()).any():
        # More of an outcome than is published, or another number of it in a whole condition.
        other = (conditions[OUTCOMES] > known) | (conditions[OUTCOMES] != known).mul(whole, axis=0)
        contradicting = tuple(
            f"{condition} {outcome.replace('_', ' ')} {conditions[outcome][condition]} instead of "
            f"{known[outcome][condition]}"
            for condition, outcome in other.stack()[lambda cells: cells].index
        )
    else:
        contradicting = ("no trial is of the nine published pairs",)
    others = trials.loc[trials.index.difference(chosen.index), "pair"]
    return Imported(
        trials=len(chosen),
        pairs=chosen["pair"].nunique(),
        complete=bool(whole.all()),
        contradicting=contradicting,
        left_out={str(pair): int(n) for pair, n in others.value_counts().sort_index().items()},
        from_pages=int((chosen["origin"] == VELOCITY_PAGES).sum()),
    )


def by_pair(trials: pd.DataFrame) -> pd.DataFrame:
    """Counts of each pair: trials and OUTCOMES."""
    return _counted(trials, "pair")


def by_condition(trials: pd.DataFrame) -> pd.DataFrame:
    """The same of each condition over the published pairs, and how many trials are published."""
    own = trials[trials["pair"].isin(PAIRS.values())]
    known = published("human_outcomes").set_index("condition")[OUTCOMES].astype(str)
    counts = _counted(own, "condition").reindex(HUMAN_CONDITIONS, fill_value=0)
    return counts.assign(published=known.agg(" ".join, axis=1))


def _counted(trials: pd.DataFrame, by: str) -> pd.DataFrame:
    outcomes = {
        "trials": 1,
        "left_first": trials["merged_first"] == "left",
        "right_first": trials["merged_first"] == "right",
        "collided": trials["status"] == "collided",
    }
    return pd.DataFrame(outcomes, index=trials.index).astype(int).groupby(trials[by]).sum()
