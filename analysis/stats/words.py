"""Words and deeds: whether M (merge first) and Y (yield) are followed by what they say.

A word is followed by going, or by yielding, where the mean acceleration of the next second is above
or below 0.2 m/s² either way, as of first actions.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache

import pandas as pd

from merge_runner.records import SIDES
from merge_runner_analysis.data.study import Study, of_group
from merge_runner_analysis.stats.first_action import HOLD_MPS2, Seat
from merge_runner_analysis.stats.indicators import ALPHA
from merge_runner_analysis.stats.intervals import Estimate, proportion
from merge_runner_analysis.stats.regressions import Regression, who_first_firth

CUES = {"projected_headway": "headway", "relative_velocity": "relative velocity"}


@dataclass(frozen=True, slots=True)
class Words:
    """What a driver's tactical words come to.

    ``merge_yields`` is the share of M that yielding follows, ``yield_goes`` that of Y that going
    follows. Of first words in finished trials, ``merge_second`` is the share of M of who merged
    second, ``yield_first`` that of Y of who merged first. ``first`` is Firth's logit of M as the
    first word on own headway and own relative velocity.
    """

    merge_yields: Estimate
    yield_goes: Estimate
    merge_second: Estimate
    yield_first: Estimate
    first: Regression

    @property
    def follows(self) -> str | None:
        """What the first word follows by the tests; None where there is none."""
        if not self.first.terms:
            return None
        found = [name for term, name in CUES.items() if self.first.terms[term].p < ALPHA]
        return {0: "neither", 1: "".join(found), 2: "both"}[len(found)]


@cache
def words(study: Study, seat: Seat) -> Words | None:
    """The words of a driver in the trials that ended; None where there are none."""
    columns = ["trial_id", "spec_hash", "status", "merged_first", "projected_headway_m",
               "relative_velocity_mps"]  # fmt: skip
    trials = seat.group.ended[columns]
    said = of_group(study.words, seat.group, trials).merge(trials, on=["trial_id", "spec_hash"])
    said = said[said["side"].isin([SIDES[place] for place in seat.sides])]
    if said.empty:
        return None
    first = said[said["at_first"]]
    merges, yields = (said[said["tactical"] == word]["driven_mps2"].dropna() for word in "MY")
    over = first[(first["status"] == "finished") & first["merged_first"].notna()]
    won = over["side"] == over["merged_first"]
    return Words(
        _share(merges < -HOLD_MPS2),
        _share(yields > HOLD_MPS2),
        _share(~won[over["tactical"] == "M"]),
        _share(won[over["tactical"] == "Y"]),
        _first_word(first),
    )


def _share(found: pd.Series) -> Estimate:
    return proportion(int(found.sum()), len(found))


def _first_word(first: pd.DataFrame) -> Regression:
    said = first["tactical"].unique()
    if len(said) == 1:
        return Regression(len(first), {}, f"it is {said[0]} in all {len(first)} decisions")
    found = who_first_firth(_as_trials(first))
    if found.problem:
        return replace(found, problem="there are too few, or of too few conditions, to tell")
    return found


def _as_trials(first: pd.DataFrame) -> pd.DataFrame:
    """First words as the regression reads trials: M is left first, all else the own view."""
    sign = first["side"].map({"left": 1.0, "right": -1.0})
    return pd.DataFrame(
        {
            "status": "finished",
            "merged_first": first["tactical"].map({"M": "left", "Y": "right"}),
            "projected_headway_m": sign * first["projected_headway_m"],
            "relative_velocity_mps": sign * first["relative_velocity_mps"],
        }
    )
