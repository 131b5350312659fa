"""What a trial is an example of: how a collision came about, a near miss, or a long wait."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from merge_runner.records import SIDES, Side
from merge_runner_analysis.accounts.course import BRAKING, SPEEDING_UP, TICK_S, Course

BOTH_INSISTED, BOTH_GAVE_WAY = "both insisted", "both gave way"
ONE_TOO_LITTLE, NO_ACTION, INVALID_PLAN = "one too little", "no action", "invalid plan"
COLLISIONS = (BOTH_INSISTED, BOTH_GAVE_WAY, ONE_TOO_LITTLE, NO_ACTION, INVALID_PLAN)
NEAR_MISS, LONG_WAIT = "near miss", "long wait"

ACTED_MPS = 0.5
"""From this change of speed on a driver has acted: what makes a contribution in ``joint``, too."""
NEAR_TTC_S = 1.5
"""Below this time to collision an encounter is commonly called critical: A. R. A. van der Horst, A
time-based analysis of road user behaviour in normal and critical encounters (TU Delft, 1990)."""
NEAR_GAP_M = 1.0
"""A gap that is as good as none: ours. The humans' mean is 3.85 m."""
LONG_WAIT_TIMES = 2.0
"""A wait is long where it takes so many times as long as at the initial speeds: ours."""

# Of trials that did not collide, by their columns and ``alone_s``: when the first vehicle would
# have been at the merge point if both had kept their initial speeds.
OTHER_ACCOUNTS = f"""
CASE WHEN status = 'finished' AND (gap_m < {NEAR_GAP_M} OR min_ttc_s < {NEAR_TTC_S})
    THEN '{NEAR_MISS}'
WHEN status IN ('finished', 'timeout')
    AND coalesce(time_to_merge_s, end_time_s) >= {LONG_WAIT_TIMES} * alone_s THEN '{LONG_WAIT}' END
"""
ALONE = """
SELECT trial_id, spec_hash,
    min((merge_point_m() - position_m) / nullif(velocity_mps, 0)) AS alone_s
FROM states WHERE step = 0 GROUP BY ALL
"""

Decided = Sequence[Mapping[str, Any]]
"""Decisions in the order of their numbers: side, decision, time_s, valid, tactical, fallback."""


def collision_class(course: Course, decisions: Decided) -> str:
    """How a collision came about.

    It is judged at the last sample from which one driver alone could still have avoided it, by
    braking or speeding up as hard as the vehicle can. ``invalid plan``: a driver drove on an older
    plan, or none, when its own braking could last have helped. Else by what the drivers had done
    with their speeds until that sample, from ACTED_MPS on: both gained (``both insisted``), both
    lost (``both gave way``), neither (``no action``), or not the same (``one too little``).
    """
    if any(_drove_no_plan_of_its_own(course, decisions, side) for side in SIDES):
        return INVALID_PLAN
    until = judged_at(course)
    left, right = (_way(course.change_mps(side, until)) for side in SIDES)
    if left != right:
        return ONE_TOO_LITTLE
    return {BRAKING: BOTH_GAVE_WAY, 0.0: NO_ACTION, SPEEDING_UP: BOTH_INSISTED}[left]


def judged_at(course: Course) -> int:
    """The sample at which a collision is judged: the last chance of anybody, the end where none."""
    chance = last_chance_of_all(course)
    return course.last if chance is None else chance


def last_chance_of_all(course: Course) -> int | None:
    """The last sample from which one driver alone avoids the collision; None: there is none."""
    found: int | None = None
    for side in SIDES:
        for action in (BRAKING, SPEEDING_UP):
            later = course.last_chance(side, action, -1 if found is None else found)
            found = found if later is None else later
    return found


def _drove_no_plan_of_its_own(course: Course, decisions: Decided, side: Side) -> bool:
    own = [decision for decision in decisions if decision["side"] == side]
    if not any(decision["fallback"] for decision in own):
        return False
    chance = course.last_chance(side, BRAKING)
    if chance is None:
        return False
    until_s = course.times_s[chance] + TICK_S
    made = [decision for decision in own if decision["time_s"] <= until_s]
    return bool(made and made[-1]["fallback"])


def _way(change_mps: float) -> float:
    if abs(change_mps) < ACTED_MPS:
        return 0.0
    return SPEEDING_UP if change_mps > 0 else BRAKING
