"""The quantitative measures of a group of trials, with their intervals."""

from __future__ import annotations

from dataclasses import dataclass

from analysis.intervals import Estimate, mean, proportion
from analysis.published import published
from analysis.study import Group


@dataclass(frozen=True, slots=True)
class Measure:
    """A measure of Table VII.

    ``column`` is that of ``load_trials`` for a mean, None for the collision rate. ``counts`` is the
    SQL predicate of the trials that it rests on. Rates are printed in percent.
    """

    name: str
    heading: str
    meaning: str
    column: str | None
    rate: bool
    counts: str


MEASURES = (
    Measure(
        "collided_percent",
        "coll. (%)",
        "share of all ended trials that ended in a collision",
        None,
        True,
        "status <> 'failed'",
    ),
    Measure(
        "gap_m",
        "gap (m)",
        "net gap when the first vehicle reaches the merge point",
        "gap_m",
        False,
        "gap_m IS NOT NULL",
    ),
    Measure(
        "rmse_mps",
        "RMSE (m/s)",
        "RMSE of the speed from the initial speed, mean of both vehicles, to the first merge",
        "rmse_mps",
        False,
        "rmse_mps IS NOT NULL",
    ),
    Measure(
        "joint_percent",
        "joint (%)",
        "share of finished trials with an RMSE of at least 0.5 m/s on both sides",
        "joint",
        True,
        "joint IS NOT NULL",
    ),
)

LEFT_FIRST = Measure(
    "left_first_percent",
    "left first (%)",
    "share of finished trials with a first merger in which it is the left vehicle",
    "merged_first",
    True,
    "status = 'finished' AND merged_first IS NOT NULL",
)


def counts(group: Group, measure: Measure) -> tuple[int, int]:
    """Successes and n of a rate."""
    if measure.column is None:
        ended = group.outcomes[group.outcomes["status"] != "failed"]
        return int((ended["status"] == "collided").sum()), len(ended)
    if measure is LEFT_FIRST:
        finished = group.outcomes[group.outcomes["status"] == "finished"]
        first = finished["merged_first"].dropna()
        return int((first == "left").sum()), len(first)
    known = group.finished[measure.column].dropna()
    return int(known.astype(bool).sum()), len(known)


def estimate(group: Group, measure: Measure) -> Estimate:
    """The measure of a group with its 95 % interval, rates in percent."""
    if not measure.rate:
        assert measure.column is not None
        return mean(group.finished[measure.column].to_numpy(float))
    found = proportion(*counts(group, measure))
    if found.value is None or found.low is None or found.high is None:
        return found
    return Estimate(100 * found.value, 100 * found.low, 100 * found.high, found.n)


def published_human(measure: Measure) -> float:
    """The human value that the paper prints."""
    row = published("paper_ablation_quantitative").query("driver == 'human'").iloc[0]
    return float(row[measure.name])


def known(group: Group, measure: Measure) -> bool:
    """Whether the group's trials hold this measure; before an import humans have outcomes alone."""
    return group.measured or measure.column is None
