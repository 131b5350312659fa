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

from collections.abc import Callable, Mapping
from dataclasses import astuple, dataclass, field, replace
from functools import cache, cached_property, partial
from typing import NamedTuple

import numpy as np
import pandas as pd

from merge_runner.scenarios.merge.conditions import HUMAN_CONDITIONS
from merge_runner_analysis.cache import remembered
from merge_runner_analysis.grouping import Group
from merge_runner_analysis.metrics import BOXES, COLLISIONS, GAP
from merge_runner_analysis.published import HUMAN_GAP_SD_M, PAIRS, human_outcomes, published
from merge_runner_analysis.stats import contrasts, intervals, measures, regressions
from merge_runner_analysis.stats.estimate import Estimate
from merge_runner_analysis.stats.indicators import TESTED, Judgement, fits, judge, less_humans
from merge_runner_analysis.stats.regressions import CONDITION, GAP_TERMS, MIN_PAIRS, Regression
from merge_runner_analysis.stats.score_interval import wilson
from merge_runner_analysis.study import StudyResults
from merge_runner_analysis.wording import (
    ALPHA,
    MEASURES,
    OPEN,
    SHOWN,
    STRONGER,
    UNLIKE,
    WEAKER,
    Fact,
    Measure,
    Why,
)

PUBLISHED = Fact(Why.PUBLISHED)
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
        return {name: (of.driver(self), of.human(self)) for name, of in STATISTICS.items()}

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
class Statistic:
    """Estimators of a measure for a driver and for humans, and its test (default: Welch's).

    The test is of the difference, or of the driver's value against a margin. If an ``indicator``
    holds by its robust test, the trait is shown.
    """

    driver: Callable[[Both], Estimate]
    human: Callable[[Both], Estimate]
    test: Callable[[Both], Estimate | None] | None = None
    indicator: str = ""


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
        indicator, (driver, human) = STATISTICS[name].indicator, both.estimates[name]
        why = both.judgements[indicator].why if indicator else None
        remarks = driver.problem, human.problem, None if driver.problem else why
        state, tested = states.get(name, OPEN if driver.undecided else ""), Estimate()
        if name in tests:
            tested = intervals.at(tests[name], tests[name].level)
            if measure.margin is not None and tested.low is not None:
                driver = replace(driver, low=tested.low, high=tested.high)
        comparison = Comparison(measure, driver, human, tested, state, remarks, counts.get(name))
        comparisons.append(comparison)
    return tuple(comparisons)


@remembered
def of_humans(study: StudyResults) -> dict[str, Estimate]:
    """Return the humans by measure, over all conditions; a few imported trials change nothing."""
    human = study.human
    both = Both(human if _imported(human) else replace(human, trials=human.outcomes), human)
    return {name: statistic.human(both) for name, statistic in STATISTICS.items()}


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
    first = {name: _went_first(human.outcomes, name) for name in ("headway", "velocity")}
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
    tests = {}
    for name, statistic in STATISTICS.items():
        default = partial(intervals.difference, *both.estimates[name])
        if test := statistic.test(both) if statistic.test else default():
            tests[name] = test
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
        measure, statistic = MEASURES[name], STATISTICS[name]
        differs = test.p_holm is not None and test.p_holm < ALPHA
        states[name] = UNLIKE if differs else OPEN
        if _within(measure, test):
            states[name] = SHOWN
        elif measure.margin is None and statistic.indicator in traits:
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


def _who_first(both: Both, term: str) -> Estimate | None:
    """Return the difference of a slope, from one model of both with all interactions."""
    difference = _less_humans(both.group, both.human)
    alone = fits(both.group).firth, fits(both.human).firth
    if any(term not in fit.terms for fit in (*alone, difference)):
        return None
    b, se, _, p = astuple(difference.terms[term])
    ends_at, least = partial(difference.interval, term), intervals.detectable(se)
    return Estimate(b, se=se, p=p, detectable=least, ends_at=ends_at)


@remembered
def _less_humans(group: Group, human: Group) -> Regression:
    return regressions.who_first_firth(group.outcomes, less=human.outcomes)


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


def _held(both: Both) -> Estimate | None:
    likeness = both.likeness
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


def _of_fit(human: Group, estimate: Estimate) -> Estimate:
    """Return an estimate of the humans' regression of the gap, with its source or problem."""
    if estimate.problem:
        return replace(estimate, problem=Fact(Why.OF_HUMANS, (estimate.problem,)))
    return estimate if _imported(human) else replace(estimate, source=PUBLISHED)


def _imported(human: Group) -> bool:
    return human.measured and human.finished["pair"].nunique() >= MIN_PAIRS


def _gap(group: Group) -> Estimate:
    estimate = measures.mean_of(group.finished, GAP.column)
    why = Why.ONE_GAP if estimate.n else Why.NO_GAP
    return replace(estimate, problem=Fact(why)) if estimate.se is None else estimate


def human_gap(human: Group, group: Group) -> Estimate:
    """Return the humans' mean gap, weighted by condition as the group's trials that have a gap.

    The published mean is moved by the published regression; its error is the spread of the pairs'
    random intercepts, which are shrunken, so that it is rather too small.
    """
    gaps = group.finished[group.finished[GAP.column].notna()] if group.measured else None
    if _imported(human):
        known = human.finished[human.finished[GAP.column].notna()]
        if gaps is None or gaps.empty:
            return measures.mean_of(known, GAP.column)
        shares = gaps["condition"].value_counts()
        if lacking := {*shares.index} - {*known["condition"]}:
            return Estimate(n=len(known), problem=Fact(Why.NO_GAP_THERE, (len(lacking),)))
        shared = known[known["condition"].isin(shares.index)]
        return measures.mean_of(shared, GAP.column, None if group is human else shares)
    (value, usual, spread), fit, moved = (
        _published_gap(),
        human_fit(human),
        np.zeros(len(GAP_TERMS)),
    )
    if gaps is not None and len(gaps):
        moved = _gap_design(gaps).mean(axis=0) - usual
    assert fit.covariance is not None
    se = float(spread**2 + moved @ fit.covariance @ moved) ** 0.5
    value += float(moved @ [term.b for term in fit.terms.values()])
    return replace(intervals.estimate(value, se, len(PAIRS) - 1, fit.n), source=PUBLISHED)


@cache
def _published_gap() -> tuple[float, regressions.Array, float]:
    """Return the humans' mean gap in m, the mean regressors of its trials, and its error in m."""
    row = published("paper_ablation_quantitative").query("driver == 'human'").iloc[0]
    outcomes = human_outcomes().query("status == 'finished'")
    spread = float(published("human_gap_intercepts")["intercept_m"].std() / len(PAIRS) ** 0.5)
    return float(row["gap_m"]), _gap_design(outcomes).mean(axis=0), spread


def _gap_design(trials: pd.DataFrame) -> regressions.Array:
    return regressions.gap_design(*trials[CONDITION].to_numpy(float).T)


@remembered
def human_fit(human: Group) -> Regression:
    """Return the humans' regression of the gap: by pairs, or as published.

    Covariances that are not published follow from the outcomes and one standard deviation.
    """
    if _imported(human):
        return regressions.by_pairs(regressions.gap_ols, human.trials, "gap_m")
    rows = published("paper_gap").query("driver == 'human'").set_index("term")
    design = _gap_design(human_outcomes().query("status == 'finished'"))
    covariance = HUMAN_GAP_SD_M**2 * np.asarray(np.linalg.inv(design.T @ design))
    terms = {
        name: regressions.Term(float(rows.at[name, "b"]), float(rows.at[name, "se"]), None, np.nan)
        for name in GAP_TERMS
    }
    n = int(rows["n"].iloc[0])
    return Regression(n, terms, freedom=n - len(GAP_TERMS), covariance=covariance)


@remembered
def _slope(group: Group, term: str) -> Estimate:
    fit = fits(group).firth
    if fit.problem:
        return Estimate(n=fit.n, problem=fit.problem)
    b, se = fit.terms[term].b, fit.terms[term].se
    if ends := fit.interval(term, intervals.LEVEL):
        return Estimate(b, *ends, fit.n, se)
    return Estimate(b, n=fit.n, se=se, problem=Fact(Why.NO_PROFILE))


def _headway(fit: Regression) -> Estimate:
    if fit.problem:
        return Estimate(n=fit.n, problem=fit.problem)
    term = fit.terms[TESTED["I3"][0]]
    return intervals.estimate(term.b, term.se, fit.freedom, fit.n)


def _moved(fit: Regression, group: Group) -> Estimate:
    """Return the largest difference of gaps that relative velocity alone makes for a group."""
    moved = fit.moved(group.trials)
    if moved is None:
        return Estimate(n=fit.n, problem=fit.problem or Fact(Why.NONE_APART))
    return Estimate(moved.most, *moved.interval(intervals.LEVEL), fit.n)


def _collided(group: Group) -> Estimate:
    (k, n), cut_off = measures.counts(group, BOXES), measures.undecided(group, BOXES)
    if not n + cut_off:
        return Estimate(problem=Fact(Why.NONE_ENDED, (group.left_out,)))
    problem = measures.undecided_note(group, BOXES)
    return replace(measures.estimate(group, BOXES), problem=problem, k=k, undecided=cut_off)


def _standardised(both: Both) -> Estimate:
    """Return the humans' collisions, with conditions weighted as in a group's trials."""
    played = both.group.ended_outcomes["condition"].value_counts()  # with those undecided
    outcomes = both.human.outcomes
    shared = outcomes[outcomes["condition"].isin(played.index)]
    if shared.empty:
        return Estimate(problem=Fact(Why.NOBODY_THERE))
    counts = shared.groupby("condition")[BOXES.column].agg(["sum", "size"]).astype(int)
    k, n = counts.to_numpy().T
    shares = played[counts.index].to_numpy() / played[counts.index].sum()
    rate, effective_n = float(shares @ (k / n)), 1 / float(shares**2 @ (1 / n))
    low, high = wilson(rate, effective_n)
    return Estimate(100 * rate, 100 * low, 100 * high, len(shared), effective_n=effective_n)


def _goes_first(indicator: str) -> Statistic:
    term = TESTED[indicator][0]
    return Statistic(
        lambda both: _slope(both.group, term),
        lambda both: _slope(both.human, term),
        partial(_who_first, term=term),
        indicator,
    )


STATISTICS = {
    "headway": _goes_first("I1"),
    "velocity": _goes_first("I2"),
    "collisions": Statistic(lambda both: _collided(both.group), _standardised, _rates),
    "gap": Statistic(
        lambda both: _gap(both.group),
        lambda both: human_gap(both.human, both.group),
    ),
    "gap-headway": Statistic(
        lambda both: _headway(fits(both.group).hc3),
        lambda both: _of_fit(both.human, _headway(human_fit(both.human))),
        indicator="I3",
    ),
    "gap-velocity": Statistic(
        lambda both: _moved(fits(both.group).hc3, both.group),
        lambda both: _of_fit(both.human, _moved(human_fit(both.human), both.group)),
        _velocity,
        "I4",
    ),
    "held": Statistic(
        lambda both: both.likeness,
        lambda both: Estimate(0.0, n=len(both.human.finished)),
        _held,
    ),
}
