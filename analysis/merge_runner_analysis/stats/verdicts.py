"""Drivers beside the humans: estimate, interval and test of each measure from one model.

- Who goes first: Firth's penalised logit of left-first on h and dv, finite also under separation,
  with profile likelihood intervals and likelihood-ratio tests (Heinze and Schemper 2002); of a
  difference one model of both, in which every term may differ.
- Collisions: Fisher's exact test within conditions, with the melded interval that agrees with it.
- The mean gap: Student's t over trials, the humans' over their nine pairs, in the conditions of the
  driver's trials; Welch's test.
- The slope of the gap on headway: least squares with HC3 errors, the humans' as published or by
  pairs. I4: the largest difference of predicted gaps that relative velocity alone makes.
- I5: how far accelerations are held, in human standard deviations (see ``likeness``).

The p of a driver's measures are corrected together by Holm (1979), and a driver differs in those
with a corrected p below 5 %. The interval that such a state rests on has the level at which Holm
tested it, so that both agree.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import astuple, dataclass, replace
from functools import partial
from typing import NamedTuple

import numpy as np
import pandas as pd

from merge_runner.scenarios.merge.conditions import HUMAN_CONDITIONS
from merge_runner_analysis.cache import remembered
from merge_runner_analysis.grouping import Group
from merge_runner_analysis.metrics import BOXES, COLLISIONS, GAP
from merge_runner_analysis.published import (
    HUMAN_GAP_SD_M,
    PAIRS,
    human_outcomes,
    published,
)
from merge_runner_analysis.stats import intervals
from merge_runner_analysis.stats.contrasts import (
    corrected,
    detectable_rate,
    shared_cells,
    weighted,
)
from merge_runner_analysis.stats.estimate import Estimate
from merge_runner_analysis.stats.indicators import (
    ALPHA,
    TESTED,
    fits,
    judge,
    less_humans,
)
from merge_runner_analysis.stats.intervals import LEVEL, melded
from merge_runner_analysis.stats.measures import (
    counts,
    estimate,
    mean_of,
    undecided,
    undecided_note,
    values,
)
from merge_runner_analysis.stats.regressions import (
    CONDITION,
    GAP_TERMS,
    MIN_PAIRS,
    Array,
    Regression,
    Term,
    by_pairs,
    gap_design,
    gap_ols,
    who_first_firth,
)
from merge_runner_analysis.stats.score_interval import wilson
from merge_runner_analysis.study import Study
from merge_runner_analysis.wording import (
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

Ends = tuple[float, float] | None


class Both(NamedTuple):
    """A driver's trials in conditions of humans, and the humans.

    ``likeness`` is how far the driver's accelerations are held, less the humans' (I5).
    """

    group: Group
    human: Group
    likeness: Estimate = Estimate()


class Counted(NamedTuple):
    """How many of ``n`` trials went as a measure has it, and the humans' in these conditions."""

    k: int
    n: int
    human_k: int
    human_n: int


@dataclass(frozen=True, slots=True)
class Statistic:
    """How a measure is estimated of a driver and of humans, and tested: if not said, by Welch.

    The test is of the difference, or of a value with a margin against that. ``indicator`` is the
    one whose own test shows the trait.
    """

    own: Callable[[Both], Estimate]
    human: Callable[[Both], Estimate]
    test: Callable[[Both], Estimate | None] | None = None
    indicator: str = ""

    def tested(self, both: Both) -> Estimate | None:
        """The test, if it can be made."""
        if self.test:
            return self.test(both)
        return intervals.difference(self.own(both), self.human(both))


@dataclass(frozen=True, slots=True)
class Comparison:
    """A driver beside the humans in one measure.

    ``tested`` is what the state rests on, at the level of its test: driver minus humans, or the
    driver's value where the measure has a margin. It is empty where there is no test. ``counted``
    is what a person sees of it at once.
    """

    measure: Measure
    own: Estimate
    human: Estimate
    tested: Estimate
    state: str
    remarks: tuple[Fact | None, ...]
    counted: Counted | None


@remembered
def compared(study: Study, group: Group) -> tuple[Comparison, ...]:
    """Compare a driver with the humans by every measure."""
    alike = in_human_conditions(group)
    both = Both(alike, study.human, _likeness(study, alike))
    tests = tests_of(both)
    states = decided(both, tests)
    judgements = judge(fits(alike).firth, fits(alike).hc3, robust=True)
    seen = counted(both)
    found = []
    for name, measure in MEASURES.items():
        statistic = STATISTICS[name]
        own, human = statistic.own(both), statistic.human(both)
        why = judgements[statistic.indicator].why if statistic.indicator else None
        remarks = own.problem, human.problem, None if own.problem else why
        state, tested = states.get(name, OPEN if own.undecided else ""), Estimate()
        if name in tests:
            tested = intervals.at(tests[name], tests[name].level)
            if measure.margin is not None and tested.low is not None:
                own = replace(own, low=tested.low, high=tested.high)
        found.append(Comparison(measure, own, human, tested, state, remarks, seen.get(name)))
    return tuple(found)


@remembered
def of_humans(study: Study) -> dict[str, Estimate]:
    """The humans by measure, over all conditions."""
    both = Both(study.human, study.human)
    return {name: statistic.human(both) for name, statistic in STATISTICS.items()}


def counted(both: Both) -> dict[str, Counted]:
    """What a person counts, by measure; nothing is counted where no trial could go so.

    Crashes by the rule that was played, the humans' by theirs. Who goes first: the one ahead, and
    where neither is, the slower one.
    """
    played = both.human.outcomes["condition"].isin(both.group.ended["condition"])
    humans = both.human.outcomes[played]
    seen = {
        "collisions": values(replace(both.human, published_outcomes=humans), BOXES).astype(bool),
        **{name: _went_first(humans, name) for name in ("headway", "velocity")},
    }
    own = {name: went_so(both.group, name) for name in seen}
    return {
        name: Counted(int(of.sum()), len(of), int(seen[name].sum()), len(seen[name]))
        for name, of in own.items()
        if len(of)
    }


def went_so(group: Group, measure: str) -> pd.Series:
    """Whether each trial of a driver that could go as a measure counts it did, by its index.

    Only those in conditions of humans count.
    """
    alike = in_human_conditions(group)
    if measure == "collisions":
        return values(alike, COLLISIONS).astype(bool)
    return _went_first(alike.trials, measure)


def _went_first(outcomes: pd.DataFrame, measure: str) -> pd.Series:
    """Whether the one ahead, or side by side the slower one, went first, where there is one."""
    headway, velocity = (np.sign(outcomes[name]) for name in CONDITION)
    expected = headway if measure == "headway" else -velocity.where(headway == 0, 0)
    first = outcomes["merged_first"].map({"left": 1, "right": -1})
    return (first == expected)[first.notna() & (expected != 0)]


def in_human_conditions(group: Group) -> Group:
    """The group's trials in conditions that humans drove: others would pass for a difference."""
    if group.trials["condition"].isin(HUMAN_CONDITIONS).all():
        return group
    return group.part(lambda trials: trials["condition"].isin(HUMAN_CONDITIONS))


def tests_of(both: Both) -> dict[str, Estimate]:
    """The tests of a driver's measures, corrected over all of them, each with its level.

    Those that cannot be made are missing.
    """
    tests = {
        name: test
        for name, statistic in STATISTICS.items()
        if (test := statistic.tested(both)) is not None
    }
    p = {name: test.p for name, test in tests.items() if test.p is not None}
    p_holm = dict(zip(p, corrected([*p.values()]), strict=True))
    levels = holm_levels(p, p_holm)
    for name in p:
        level = WITHIN_LEVEL if _within(MEASURES[name], tests[name]) else levels[name]
        tests[name] = replace(tests[name], p_holm=p_holm[name], level=level)
    return tests


def decided(both: Both, tests: Mapping[str, Estimate]) -> dict[str, str]:
    """The state of each measure that is tested; see ``Measure.rule``."""
    judgements = judge(fits(both.group).firth, fits(both.group).hc3, robust=True)
    traits = {name for name, judgement in judgements.items() if judgement.passed}
    states = {}
    for name, test in tests.items():
        measure, statistic = MEASURES[name], STATISTICS[name]
        differs = test.p_holm is not None and test.p_holm < ALPHA
        states[name] = UNLIKE if differs else OPEN
        if _within(measure, test):
            states[name] = SHOWN
        elif measure.margin is None and statistic.indicator in traits:
            states[name] = _strength(statistic, both) if differs else SHOWN
    return states


def _strength(statistic: Statistic, both: Both) -> str:
    own, human = statistic.own(both).value, statistic.human(both).value
    assert own is not None
    assert human is not None
    return WEAKER if abs(own) < abs(human) else STRONGER


def _within(measure: Measure, test: Estimate) -> bool:
    """Whether a value with a margin is inside by two one-sided tests (Schuirmann 1987)."""
    if measure.margin is None:
        return False
    ends = intervals.at(test, WITHIN_LEVEL).bounds()
    return ends is not None and max(-ends[0], ends[1]) < measure.margin


def holm_levels(p: Mapping[str, float], p_holm: Mapping[str, float]) -> dict[str, float]:
    """The levels of intervals that exclude no difference where the corrected p are below ALPHA.

    Holm tests the smallest of m p-values at ALPHA / m, the next at ALPHA / (m - 1), and so on; all
    from the first that fails are as at that step.
    """
    sure = sum(value < ALPHA for value in p_holm.values())
    order = sorted(p, key=lambda name: p[name])
    return {name: 1 - ALPHA / (len(order) - min(place, sure)) for place, name in enumerate(order)}


def _who_first(both: Both, term: str) -> Estimate | None:
    """A slope of who goes first: a term of one model of both, in which every term may differ."""
    less = _less_humans(both.group, both.human)
    alone = fits(both.group).firth, fits(both.human).firth
    if any(term not in fit.terms for fit in (*alone, less)):
        return None
    b, se, _, p = astuple(less.terms[term])
    least = intervals.detectable(se)
    return Estimate(b, se=se, p=p, detectable=least, ends_at=partial(less.interval, term))


@remembered
def _less_humans(group: Group, human: Group) -> Regression:
    return who_first_firth(group.outcomes, less=human.outcomes)


def _rates(both: Both) -> Estimate | None:
    """Collisions in percent; None with undecided trials, whose rate has no value."""
    group, human = both.group, both.human
    cells = shared_cells(group.ended_outcomes, human.outcomes, BOXES.column)
    if cells is None or undecided(group, BOXES):
        return None
    (k, n), humans = counts(group, BOXES), _standardised(both)
    assert humans.value is not None
    assert humans.weight is not None
    rates, p = ((k / n, n), (humans.value / 100, humans.weight)), cells.p

    def interval(level: float) -> Ends:
        low, high = melded(*rates, p, level)
        return 100 * low, 100 * high

    least = detectable_rate(n, humans.n, humans.value / 100)
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


def _likeness(study: Study, group: Group) -> Estimate:
    likeness = less_humans(study, group) if len(group.finished) else None
    if likeness is not None and likeness.value is not None:
        return likeness
    why = Why.NONE_ACTED if study.calibrated else Why.FEW_HUMANS
    return Estimate(n=len(group.finished), problem=Fact(why))


def _of_fit(human: Group, found: Estimate) -> Estimate:
    """What follows from the humans' regression of the gap, and where that is from."""
    if found.problem:
        return replace(found, problem=Fact(Why.OF_HUMANS, (found.problem,)))
    return found if _imported(human) else replace(found, source=PUBLISHED)


def _imported(human: Group) -> bool:
    return human.measured and human.finished["pair"].nunique() >= MIN_PAIRS


def _gap(group: Group) -> Estimate:
    found = mean_of(group.finished, GAP.column)
    why = Why.ONE_GAP if found.n else Why.NO_GAP
    return replace(found, problem=Fact(why)) if found.se is None else found


def human_gap(human: Group, group: Group) -> Estimate:
    """The humans' mean gap in the conditions of a group's trials with a gap, as these weigh.

    The published mean is moved by what the published regression predicts for these conditions. It
    has the spread of the nine pairs: of their random intercepts, which are shrunken, so that it is
    rather too small.
    """
    gaps = group.finished[group.finished[GAP.column].notna()] if group.measured else None
    if _imported(human):
        shares = None if gaps is None else gaps["condition"].value_counts()
        there = human.finished.loc[human.finished[GAP.column].notna(), "condition"]
        if shares is not None and (lacking := {*shares.index} - {*there}):
            return Estimate(n=len(there), problem=Fact(Why.NO_GAP_THERE, (len(lacking),)))
        if shares is not None and not len(shares):
            shares = None
        within = there if shares is None else there[there.isin(shares.index)]
        trials = human.finished.loc[within.index]
        return mean_of(trials, GAP.column, None if group is human else shares)
    row = published("paper_ablation_quantitative").query("driver == 'human'").iloc[0]
    fit, outcomes = human_fit(human), human_outcomes().query("status == 'finished'")
    moved = np.zeros(len(GAP_TERMS))
    if gaps is not None and len(gaps):
        moved = _mean_design(gaps) - _mean_design(outcomes)
    assert fit.covariance is not None
    spread = published("human_gap_intercepts")["intercept_m"].std() / len(PAIRS) ** 0.5
    se = float(spread**2 + moved @ fit.covariance @ moved) ** 0.5
    value = float(row["gap_m"]) + float(moved @ [term.b for term in fit.terms.values()])
    return replace(intervals.estimate(value, se, len(PAIRS) - 1, fit.n), source=PUBLISHED)


def _mean_design(trials: pd.DataFrame) -> Array:
    return np.asarray(gap_design(*trials[CONDITION].to_numpy(float).T).mean(axis=0))


@remembered
def human_fit(human: Group) -> Regression:
    """The humans' regression of the gap: by pairs, or as published.

    The errors that are published follow from the published outcomes and one standard deviation of
    the gaps about their regression; so do the covariances that are not.
    """
    if _imported(human):
        return by_pairs(gap_ols, human.trials, "gap_m")
    rows = published("paper_gap").query("driver == 'human'").set_index("term")
    finished = human_outcomes().query("status == 'finished'")
    design = gap_design(*finished[CONDITION].to_numpy(float).T)
    covariance = HUMAN_GAP_SD_M**2 * np.asarray(np.linalg.inv(design.T @ design))
    terms = {
        name: Term(float(rows.at[name, "b"]), float(rows.at[name, "se"]), None, np.nan)
        for name in GAP_TERMS
    }
    n = int(rows["n"].iloc[0])
    return Regression(n, terms, freedom=n - len(GAP_TERMS), covariance=covariance)


@remembered
def _slope(group: Group, term: str) -> Estimate:
    fit = fits(group).firth
    if fit.problem:
        return Estimate(n=fit.n, problem=fit.problem)
    found, ends = fit.terms[term], fit.interval(term, LEVEL)
    if ends is None:
        return Estimate(found.b, n=fit.n, se=found.se, problem=Fact(Why.NO_PROFILE))
    return Estimate(found.b, *ends, fit.n, found.se)


def _headway(fit: Regression) -> Estimate:
    if fit.problem:
        return Estimate(n=fit.n, problem=fit.problem)
    term = fit.terms[TESTED["I3"][0]]
    return intervals.estimate(term.b, term.se, fit.freedom, fit.n)


def _moved(fit: Regression, group: Group) -> Estimate:
    """The largest difference of gaps that relative velocity alone makes in a group's conditions."""
    moved = fit.moved(group.trials)
    if moved is None:
        return Estimate(n=fit.n, problem=fit.problem or Fact(Why.NONE_APART))
    return Estimate(moved.most, *moved.interval(LEVEL), fit.n)


def _collided(group: Group) -> Estimate:
    """The share of ended trials with a collision by the humans' rule, in percent."""
    (k, n), cut_off = counts(group, BOXES), undecided(group, BOXES)
    if not n + cut_off:
        return Estimate(problem=Fact(Why.NONE_ENDED, (group.left_out,)))
    found, problem = estimate(group, BOXES), undecided_note(group, BOXES)
    return replace(found, problem=problem, k=k, undecided=cut_off)


def _standardised(both: Both) -> Estimate:
    """The humans' collisions in the conditions of a group, which weigh as they do there."""
    group, human = both.group, both.human
    played = group.ended_outcomes["condition"].value_counts()  # with those that are undecided
    there = human.outcomes[human.outcomes["condition"].isin(played.index)]
    if there.empty:
        return Estimate(problem=Fact(Why.NOBODY_THERE))
    humans = there.groupby("condition")[BOXES.column].agg(["sum", "size"]).astype(int)
    k, n = humans.to_numpy().T
    rate, as_good_as = weighted(k, n, played[humans.index].to_numpy(float))
    low, high = wilson(rate, as_good_as)
    return Estimate(100 * rate, 100 * low, 100 * high, len(there), weight=as_good_as)


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
