"""Comparison of drivers with humans: estimate, interval and test of each measure.

- Who goes first: Firth's penalised logit; the difference of slopes is that of one joint model.
- Collisions: Fisher's exact test within conditions, with the melded interval that agrees with it.
- Mean gap: Student's t over trials, of humans over their nine pairs; Welch's test.
- Slope of the gap on headway (I3): least squares with HC3 errors; the humans' as published or by
  pairs.
- I4: the largest difference of predicted gaps between conditions that differ only in relative
  velocity.
- I5: how far accelerations are held, in human standard deviations (see ``likeness``).

Holm (1979) corrects the p of all measures of a driver together. The interval of a measure has the
level at which Holm tested it, so that both agree; 90 % where I4 or I5 lies within its margin.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import astuple, dataclass, field, replace
from functools import cached_property, partial
from typing import NamedTuple

import numpy as np
import pandas as pd

from merge_runner.scenarios.merge.conditions import HUMAN_CONDITIONS
from merge_runner_analysis.cache import remembered
from merge_runner_analysis.facts import Fact, Why
from merge_runner_analysis.grouping import Group
from merge_runner_analysis.metrics import BOXES, COLLISIONS, GAP
from merge_runner_analysis.stats import contrasts, intervals, measures, regressions
from merge_runner_analysis.stats.estimate import Estimate
from merge_runner_analysis.stats.human_reference import (
    SLOPES,
    headway_slope,
    human_estimates,
    largest_difference,
    who_first_slope,
)
from merge_runner_analysis.stats.indicators import Judgement, fits, judge, less_humans
from merge_runner_analysis.stats.regressions import CONDITION
from merge_runner_analysis.study import StudyResults
from merge_runner_analysis.wording import (
    ALPHA,
    MEASURES,
    OPEN,
    SHOWN,
    STRONGER,
    UNLIKE,
    WEAKER,
    Measure,
)

# By measure: the indicator that shows its trait where it holds by its robust test.
INDICATOR = {"headway": "I1", "velocity": "I2", "gap-headway": "I3", "gap-velocity": "I4"}
# The level of an interval that lies within a margin where two one-sided tests at 5 % say so.
WITHIN_LEVEL = 1 - 2 * ALPHA


@dataclass(frozen=True, eq=False)
class Both:
    """A driver in conditions of humans, the humans, and its likeness to them in I5."""

    group: Group
    human: Group
    likeness: Estimate = field(default_factory=Estimate)

    @cached_property
    def estimates(self) -> dict[str, tuple[Estimate, Estimate]]:
        """The driver's and the humans' estimate of each measure."""
        group, human = self.group, human_estimates(self.human, self.group)
        driver = {
            **{name: who_first_slope(group, term) for name, term in SLOPES.items()},
            "collisions": _collided(group),
            "gap": _gap(group),
            "gap-headway": headway_slope(fits(group).hc3),
            "gap-velocity": largest_difference(fits(group).hc3, group),
            "held": self.likeness,
        }
        return {name: (driver[name], human[name]) for name in driver}

    @cached_property
    def judgements(self) -> dict[str, Judgement]:
        """The driver's indicators by the robust rule."""
        return judge(fits(self.group).firth, fits(self.group).hc3, robust=True)


class Counted(NamedTuple):
    """Number ``k`` of ``n`` trials with a measure's outcome, and humans' in these conditions."""

    k: int
    n: int
    human_k: int
    human_n: int


@dataclass(frozen=True, slots=True)
class Comparison:
    """Comparison of a driver with the humans in one measure, with raw counts.

    ``tested`` is the difference, or the driver's value where the measure has a margin, at the level
    of its test; it is empty without one.
    """

    measure: Measure
    driver: Estimate
    human: Estimate
    tested: Estimate
    state: str
    remarks: tuple[Fact | None, ...]
    counted: Counted | None


@remembered
def compared(study: StudyResults, group: Group) -> tuple[Comparison, ...]:
    """Compare a driver with the humans by every measure."""
    alike = comparable(group)
    both = Both(alike, study.human, _likeness(study, alike))
    tests = tests_of(both)
    states = states_of(both, tests)
    counts = counted(both)
    comparisons = []
    for name, measure in MEASURES.items():
        driver, human = both.estimates[name]
        why = both.judgements[INDICATOR[name]].why if name in INDICATOR else None
        remarks = driver.problem, human.problem, None if driver.problem else why
        state, tested = states.get(name, OPEN if driver.undecided else ""), Estimate()
        if name in tests:
            tested = intervals.at(tests[name], tests[name].level)
            if measure.margin is not None and tested.low is not None:
                driver = replace(driver, low=tested.low, high=tested.high)
        comparison = Comparison(measure, driver, human, tested, state, remarks, counts.get(name))
        comparisons.append(comparison)
    return tuple(comparisons)


def counted(both: Both) -> dict[str, Counted]:
    """Return raw counts by measure, for measures with trials that can have the outcome."""
    played = both.human.outcomes["condition"].isin(both.group.ended["condition"])
    counts = {}
    for name, of_humans in _human_hits(both.human).items():
        went, humans = hits(both.group, name), of_humans[played[of_humans.index]]
        if len(went):
            counts[name] = Counted(int(went.sum()), len(went), int(humans.sum()), len(humans))
    return counts


@remembered
def _human_hits(human: Group) -> dict[str, pd.Series]:
    first = {name: _went_first(human.outcomes, name) for name in SLOPES}
    return {"collisions": measures.values(human, BOXES).astype(bool), **first}


def hits(group: Group, measure: str) -> pd.Series:
    """Return by trial whether it has a measure's outcome, without trials that cannot have it.

    Collisions are judged by the humans' rule, or by the played rule if some are undecided.
    """
    alike = comparable(group)
    if measure == "collisions":
        metric = COLLISIONS if measures.undecided(alike, BOXES) else BOXES
        return measures.values(alike, metric).astype(bool)
    return _went_first(alike.trials, measure)


def _went_first(outcomes: pd.DataFrame, measure: str) -> pd.Series:
    """Return by trial whether the expected vehicle went first.

    For "headway" it is the one projected to be ahead, without trials side by side at the merge
    point; for "velocity" the slower one in these trials alone.
    """
    headway, velocity = (np.sign(outcomes[name]) for name in CONDITION)
    expected = headway if measure == "headway" else -velocity.where(headway == 0, 0)
    first = outcomes["merged_first"].map({"left": 1, "right": -1})
    return (first == expected)[first.notna() & (expected != 0)]


def comparable(group: Group) -> Group:
    """Return the group without conditions that no human drove, where nothing can be compared."""
    if group.trials["condition"].isin(HUMAN_CONDITIONS).all():
        return group
    return group.part(lambda trials: trials["condition"].isin(HUMAN_CONDITIONS))


def tests_of(both: Both) -> dict[str, Estimate]:
    """Return a driver's possible tests by measure, with corrected p and levels of intervals."""
    possible = {
        **_who_first(both),
        "collisions": _rates(both),
        "gap": intervals.difference(*both.estimates["gap"]),
        "gap-headway": intervals.difference(*both.estimates["gap-headway"]),
        "gap-velocity": _velocity(both),
        "held": _held(both.likeness),
    }
    tests = {name: test for name, test in possible.items() if test}
    p = {name: test.p for name, test in tests.items() if test.p is not None}
    p_holm = dict(zip(p, contrasts.corrected([*p.values()]), strict=True))
    levels = holm_levels(p, p_holm)
    for name in p:
        level = WITHIN_LEVEL if _within(MEASURES[name], tests[name]) else levels[name]
        tests[name] = replace(tests[name], p_holm=p_holm[name], level=level)
    return tests


def states_of(both: Both, tests: Mapping[str, Estimate]) -> dict[str, str]:
    """Return the state of each measure that is tested, by ``Measure.rule``."""
    traits = {name for name, judgement in both.judgements.items() if judgement.passed}
    states = {}
    for name, test in tests.items():
        measure = MEASURES[name]
        differs = test.p_holm is not None and test.p_holm < ALPHA
        states[name] = UNLIKE if differs else OPEN
        if _within(measure, test):
            states[name] = SHOWN
        elif measure.margin is None and INDICATOR.get(name) in traits:
            driver, human = (abs(estimate.value or 0.0) for estimate in both.estimates[name])
            states[name] = (WEAKER if driver < human else STRONGER) if differs else SHOWN
    return states


def _within(measure: Measure, test: Estimate) -> bool:
    """Return whether a value is within its margin by two one-sided tests (Schuirmann 1987)."""
    if measure.margin is None:
        return False
    ends = intervals.at(test, WITHIN_LEVEL).bounds()
    return ends is not None and max(-ends[0], ends[1]) < measure.margin


def holm_levels(p: Mapping[str, float], p_holm: Mapping[str, float]) -> dict[str, float]:
    """Return levels of intervals that exclude 0 exactly where Holm's p are below ALPHA."""
    sure = sum(value < ALPHA for value in p_holm.values())
    order = sorted(p, key=lambda name: p[name])
    return {name: 1 - ALPHA / (len(order) - min(place, sure)) for place, name in enumerate(order)}


def _who_first(both: Both) -> dict[str, Estimate]:
    """Return the differences of the slopes, from one model of both with all interactions."""
    joint = regressions.who_first_firth(both.group.outcomes, less=both.human.outcomes)
    every = fits(both.group).firth, fits(both.human).firth, joint
    tests = {}
    for name, term in SLOPES.items():
        if all(term in fit.terms for fit in every):
            b, se, _, p = astuple(joint.terms[term])
            ends_at, least = partial(joint.interval, term), intervals.detectable(se)
            tests[name] = Estimate(b, se=se, p=p, detectable=least, ends_at=ends_at)
    return tests


def _rates(both: Both) -> Estimate | None:
    """Return the difference in percent; None with undecided trials, whose rate has no value."""
    group, human = both.group, both.human
    cells = contrasts.shared_cells(group.ended_outcomes, human.outcomes, BOXES.column)
    if cells is None or measures.undecided(group, BOXES):
        return None
    (k, n), (_, humans), p = measures.counts(group, BOXES), both.estimates["collisions"], cells.p
    assert humans.value is not None
    assert humans.effective_n is not None
    rate, human_rate = (k / n, n), (humans.value / 100, humans.effective_n)

    def interval(level: float) -> tuple[float, float]:
        low, high = intervals.melded(rate, human_rate, p, level)
        return 100 * low, 100 * high

    least = contrasts.detectable_rate(n, humans.n, humans.value / 100)
    least = None if least is None else 100 * least
    return Estimate(100 * k / n - humans.value, p=p, detectable=least, ends_at=interval)


def _velocity(both: Both) -> Estimate | None:
    moved = fits(both.group).hc3.moved(both.group.trials)
    if moved is None:
        return None
    return Estimate(moved.most, p=moved.beyond_p, ends_at=moved.interval)


def _held(likeness: Estimate) -> Estimate | None:
    value, se, margin = likeness.value, likeness.se, MEASURES["held"].margin
    if value is None or se is None or margin is None:
        return None
    beyond, p = abs(value) - margin, 1.0
    if beyond > 0:
        p = intervals.two_sided_p(beyond / se, likeness.freedom) if se else 0.0
    return replace(likeness, p=p)


def _likeness(study: StudyResults, group: Group) -> Estimate:
    likeness = less_humans(study, group) if len(group.finished) else None
    if likeness is not None and likeness.value is not None:
        return likeness
    why = Why.NONE_ACTED if study.calibrated else Why.FEW_HUMANS
    return Estimate(n=len(group.finished), problem=Fact(why))


def _gap(group: Group) -> Estimate:
    estimate = measures.mean_of(group.finished, GAP.column)
    why = Why.ONE_GAP if estimate.n else Why.NO_GAP
    return replace(estimate, problem=Fact(why)) if estimate.se is None else estimate


def _collided(group: Group) -> Estimate:
    (k, n), cut_off = measures.counts(group, BOXES), measures.undecided(group, BOXES)
    if not n + cut_off:
        return Estimate(problem=Fact(Why.NONE_ENDED, (group.left_out,)))
    problem = measures.undecided_note(group, BOXES)
    return replace(measures.estimate(group, BOXES), problem=problem, k=k, undecided=cut_off)
