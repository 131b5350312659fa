"""What the imported human trials are, beside the 990 that are published."""

from __future__ import annotations

from dataclasses import dataclass

import pandas as pd

from analysis.published import HUMAN_TRIALS, published

OUTCOMES = ("left_first", "right_first", "collided")


@dataclass(frozen=True, slots=True)
class Imported:
    """Human trials that were imported.

    ``complete``: every condition has as many trials as are published, so that they can stand in
    the place of the published counts. ``contradicting`` names, in words, the counts that no part
    of the published trials can have: then these are another data set.
    """

    trials: int
    pairs: int
    complete: bool
    contradicting: tuple[str, ...]

    @property
    def label(self) -> str:
        """How a row of these trials is named."""
        if self.contradicting:
            return f"humans (another data set, {self.trials} trials)"
        if not self.complete:
            return f"humans ({self.trials} of {HUMAN_TRIALS} imported)"
        return "human"


def imported(trials: pd.DataFrame) -> Imported:
    """Compare human rows of ``load_trials`` with the published counts."""
    expected = published("human_outcomes").set_index("condition")[list(OUTCOMES)]
    found = pd.DataFrame(
        {
            "left_first": trials["merged_first"] == "left",
            "right_first": trials["merged_first"] == "right",
            "collided": trials["status"] == "collided",
        }
    )
    counts = found.groupby(trials["condition"]).sum().reindex(expected.index, fill_value=0)
    sizes = trials["condition"].value_counts().reindex(expected.index, fill_value=0)
    return Imported(
        trials=len(trials),
        pairs=trials["pair"].nunique(),
        complete=bool((sizes >= expected.sum(axis=1)).all()),
        contradicting=tuple(
            f"{condition}: {counts.loc[condition, outcome]} {outcome.replace('_', ' ')} where "
            f"{expected.loc[condition, outcome]} are published"
            for condition in expected.index
            for outcome in OUTCOMES
            if counts.loc[condition, outcome] > expected.loc[condition, outcome]
        ),
    )
