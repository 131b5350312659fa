"""The quantitative measures of a group of trials, with their intervals."""

from __future__ import annotations

from dataclasses import dataclass

from analysis.data.reference_data import published
from analysis.data.study import Group
from analysis.stats.intervals import Estimate, mean, proportion


@dataclass(frozen=True, slots=True)
class Measure:
    """A measure of Table VII.

    ``column`` is that of a group's trials. ``counts`` is the predicate of the trials that it rests
    on. Rates are printed in percent.
    """

    name: str
    heading: str
    meaning: str
    column: str
    rate: bool
    counts: str


COLLISIONS = Measure(
    "collided_percent",
    "coll. (%)",
    "share of ended trials with a collision by the rule of their scenario, looked for at its steps "
    "(the paper's: centres closer than a vehicle length, every 0.2 s)",
    "collided",
    True,
    "collided IS NOT NULL",
)
BOXES = Measure(
    "collided_boxes_percent",
    "coll. boxes (%)",
    "share of ended trials with a collision by the rule of the human experiment: boxes that "
    "overlap, looked for at 20 Hz",
    "collided_boxes",
    True,
    "collided_boxes IS NOT NULL",
)
GAP = Measure(
    "gap_m",
    "gap (m)",
    "net gap when the first vehicle reaches the merge point",
    "gap_m",
    False,
    "gap_m IS NOT NULL",
)
RMSE = Measure(
    "rmse_mps",
    "RMSE (m/s)",
    "RMSE of the speed from the initial speed, mean of both vehicles, to the first merge",
    "rmse_mps",
    False,
    "rmse_mps IS NOT NULL",
)
JOINT = Measure(
    "joint_percent",
    "joint (%)",
    "share of finished trials with an RMSE of at least 0.5 m/s on both sides",
    "joint",
    True,
    "joint IS NOT NULL",
)
LEFT_FIRST = Measure(
    "left_first_percent",
    "left first (%)",
    "share of finished trials with a first merger in which it is the left vehicle",
    "merged_first",
    True,
    "status = 'finished' AND merged_first IS NOT NULL",
)
MEASURES = (COLLISIONS, BOXES, GAP, RMSE, JOINT)
# What the published counts tell of the humans.
OUTCOMES = (BOXES, LEFT_FIRST)
RULES_NOTE = (
    f"{COLLISIONS.heading}: by the rule of the trials' scenario, in the paper centres closer than "
    f"a vehicle length at a step of 0.2 s; {BOXES.heading}: by the rule of the human experiment, "
    "boxes that overlap, looked for at 20 Hz, the one by which drivers are compared with humans"
)


def counts(group: Group, measure: Measure) -> tuple[int, int]:
    """Successes and n of a rate."""
    if measure is LEFT_FIRST:
        finished = group.outcomes[group.outcomes["status"] == "finished"]
        first = finished["merged_first"].dropna()
        return int((first == "left").sum()), len(first)
    trials = {COLLISIONS: group.trials, BOXES: group.outcomes}.get(measure, group.finished)
    known = trials[measure.column].dropna()
    return int(known.astype(bool).sum()), len(known)


def undecided(group: Group, measure: Measure) -> str:
    """How many trials are left out of a collision rate, since their traces leave it open."""
    if measure not in (COLLISIONS, BOXES) or not known(group, measure):
        return ""
    ended = group.ended if measure is COLLISIONS else group.ended_outcomes
    left_open = len(ended) - counts(group, measure)[1]
    if not left_open:
        return ""
    return f"{measure.heading}: {left_open} of {len(ended)} trials end undecided and are left out"


def estimate(group: Group, measure: Measure) -> Estimate:
    """The measure of a group with its 95 % interval, rates in percent."""
    if not measure.rate:
        return mean(group.finished[measure.column].to_numpy(float))
    found = proportion(*counts(group, measure))
    if found.value is None or found.low is None or found.high is None:
        return found
    return Estimate(100 * found.value, 100 * found.low, 100 * found.high, found.n)


def published_human(measure: Measure) -> float:
    """The human value that the paper prints; of collisions it is that of boxes."""
    row = published("paper_ablation_quantitative").query("driver == 'human'").iloc[0]
    return float(row[COLLISIONS.name if measure is BOXES else measure.name])


def known(group: Group, measure: Measure) -> bool:
    """Whether a group's trials hold this measure.

    Before an import humans have outcomes alone, and until it is complete no collisions but these.
    """
    if measure in OUTCOMES:
        return True
    return group.measured and not (measure is COLLISIONS and group.published_outcomes is not None)


def outcomes_note(group: Group) -> str:
    """What rests on the published outcomes, where only a part of the traces is imported."""
    if not group.measured or group.published_outcomes is None:
        return ""
    return (
        f"who merged first and {BOXES.heading}: the {len(group.published_outcomes)} published "
        f"outcomes; the rest: {len(group.trials)} imported trials, {len(group.finished)} finished"
    )
