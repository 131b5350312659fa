"""Drivers beside the humans: estimate, interval and test of each measure from one model.

- Who goes first: Firth's penalised logit of left-first on h and dv, finite also under separation,
  with profile likelihood intervals and likelihood-ratio tests (Heinze and Schemper 2002); of a
  difference one model of both, in which every term may differ.
- Collisions: rates with Wilson's interval, the humans' with the weights of the driver's conditions.
- The mean gap: Student's t over trials, the humans' over their nine pairs; Welch's test.
- Slopes of the gap: least squares with HC3 errors, the humans' as published or by pairs.
- I5: how far accelerations are held, in human standard deviations (see ``likeness``).

A difference of rates has Newcombe's interval (1998), and its p is the level at which that interval
leaves 0 out.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache
from math import inf

import numpy as np

from merge_runner.scenarios.merge.conditions import HUMAN_CONDITIONS
from merge_runner_analysis.data.reference_data import HUMAN_GAP_PAIR_SD_M, PAIRS, published
from merge_runner_analysis.data.study import Group, Study
from merge_runner_analysis.metrics import BOXES
from merge_runner_analysis.stats import intervals, likeness
from merge_runner_analysis.stats.contrasts import corrected, detectable_rate, difference_of_rates
from merge_runner_analysis.stats.group_scores import fits, score
from merge_runner_analysis.stats.indicators import Verdict
from merge_runner_analysis.stats.intervals import Difference, newcombe, wilson
from merge_runner_analysis.stats.measures import counts, undecided, undecided_note
from merge_runner_analysis.stats.regressions import (
    GAP_TERMS,
    MIN_PAIRS,
    by_pairs,
    gap_ols,
    penalised,
    who_first_data,
)
from merge_runner_analysis.verdict_words import (
    MEASURES,
    OPEN,
    SHOWN,
    STRONGER,
    UNLIKE,
    WEAKER,
    Measure,
)

# By measure: the term of its regression, the factor to its unit, and the indicator that tests it.
SLOPES = {
    "headway": ("projected_headway", 1.0, "I1"),
    "velocity": ("relative_velocity", 1.0, "I2"),
    "gap-headway": ("abs_projected_headway", 1.0, "I3"),
    "gap-velocity": ("abs_relative_velocity", 0.8, "I4"),
}
WHO_FIRST = ("headway", "velocity")


@dataclass(frozen=True, slots=True)
class Estimate:
    """A value of ``n`` trials with its 95 % interval ``ci``, and with its standard error.

    ``freedom`` is that of Student's t. ``rate`` is a rate as a share, and the trials that it is as
    good as. ``problem`` says why there is no value, ``remark`` what to know of it. A rate counts
    ``k`` trials; with ``undecided`` ones it has no value, and the interval holds whether none or
    all of them count (Manski 1989).
    """

    value: float | None
    n: int
    ci: tuple[float, float] | None = None
    se: float | None = None
    freedom: float = inf
    rate: tuple[float, float] | None = None
    problem: str = ""
    remark: str = ""
    k: int | None = None
    undecided: int = 0


@dataclass(frozen=True, slots=True)
class Comparison:
    """A driver beside the humans in one measure; ``p_holm`` is corrected over its measures."""

    measure: Measure
    own: Estimate
    human: Estimate
    difference: Difference | None
    state: str
    note: str
    p_holm: float | None = None


@cache
def compared(study: Study, group: Group) -> tuple[Comparison, ...]:
    """Compare a driver with the humans by every measure."""
    found = [_compared(study, group, measure) for measure in MEASURES.values()]
    tested = [one.difference.p for one in found if one.difference]
    holm = iter(corrected(tested)[0] if tested else ())
    return tuple(
        replace(one, p_holm=float(next(holm)) if one.difference else None) for one in found
    )


@cache
def of_humans(study: Study) -> dict[str, Estimate]:
    """The humans by measure, over all conditions."""
    return {name: _human(study, study.human, name) for name in MEASURES}


def _compared(study: Study, group: Group, measure: Measure) -> Comparison:
    # Conditions that no human drove would pass for another behaviour.
    alike = group.part(lambda trials: trials["condition"].isin(HUMAN_CONDITIONS))
    own, human = _own(study, alike, measure.name), _human(study, alike, measure.name)
    difference = _difference(own, human)
    if own.undecided:
        difference = _of_worst_cases(own, human)
    elif measure.name in WHO_FIRST:
        difference = _of_slopes(alike, study.human, SLOPES[measure.name][0])
    verdict = score(study, group).robust.get(SLOPES[measure.name][2]) if measure.is_slope else None
    state = _state(measure, own, human, difference, verdict)
    notes = [own.problem, human.problem]
    if measure.name in SLOPES and verdict and verdict.passed is None and not own.problem:
        notes.append(verdict.why)
    return Comparison(measure, own, human, difference, state, "; ".join(filter(None, notes)))


def _state(
    measure: Measure,
    own: Estimate,
    human: Estimate,
    difference: Difference | None,
    verdict: Verdict | None,
) -> str:
    """The state of a measure, empty where it cannot be judged; see ``Measure.rule``."""
    if own.ci is None or (own.value is None and not own.undecided):
        return ""
    low, high = own.ci
    if measure.margin is not None:
        alike = verdict.passed if verdict else max(-low, high) < measure.margin
        if alike:
            return SHOWN
        return UNLIKE if max(low, -high) > measure.margin else OPEN
    if difference is None or human.value is None:
        return ""
    assert difference.low is not None
    assert difference.high is not None
    differs = not difference.low <= 0 <= difference.high
    if verdict is None or not verdict.passed:
        return "" if verdict and verdict.passed is None else UNLIKE if differs else OPEN
    if not differs:
        return SHOWN
    return WEAKER if abs(own.value or 0.0) < abs(human.value) else STRONGER


def _of_worst_cases(own: Estimate, human: Estimate) -> Difference | None:
    """The difference whether no undecided trial collided or all did, with the larger p.

    Its value is the one nearer to 0.
    """
    if own.k is None or human.rate is None:
        return None
    counts_of = (own.k, own.k + own.undecided)
    cases = [_of_rates(_rate(k / own.n, own.n, own.n), human) for k in counts_of]
    least, most = cases
    nearest = min(cases, key=lambda one: abs(one.value))
    return replace(nearest, low=least.low, high=most.high, p=max(one.p for one in cases))


def _difference(own: Estimate, human: Estimate) -> Difference | None:
    """The driver's value less the humans'; None where one of them, or every error, is missing."""
    if own.value is None or human.value is None:
        return None
    if own.rate and human.rate:
        return _of_rates(own, human)
    if own.se is None or human.se is None:
        return None
    value = own.value - human.value
    return intervals.difference(value, (own.se, own.freedom), (human.se, human.freedom))


def _of_slopes(group: Group, human: Group, term: str) -> Difference | None:
    """How a slope of who goes first differs, by Firth's fit of one model of both."""
    fit = penalised(group.outcomes, less=human.outcomes)
    bounds = None if isinstance(fit, str) else fit.interval(term)
    if isinstance(fit, str) or bounds is None or term not in fit.terms:
        return None
    slope = fit.terms[term]
    return Difference(slope.b, *bounds, slope.p, intervals.detectable(slope.se))


def _of_rates(own: Estimate, human: Estimate) -> Difference:
    """How two rates differ, in percent."""
    assert own.rate is not None
    assert human.rate is not None
    found = difference_of_rates([own.rate, human.rate])
    low, high = newcombe([own.rate, human.rate])
    least = detectable_rate(own.n, human.n, human.rate[0])
    least = None if least is None else 100 * least
    return Difference(100 * found.value, 100 * low, 100 * high, found.p, least)


def _own(study: Study, group: Group, name: str) -> Estimate:
    """A driver's estimate, of its trials in the humans' conditions."""
    if name == "collisions":
        return _collided(group)
    if name == "gap":
        return _mean(group.finished["gap_m"].dropna().to_numpy(float))
    if name == "held":
        return _held(study, group)
    return _slope(group, name)


def _human(study: Study, group: Group, name: str) -> Estimate:
    """The humans' estimate beside a group's: rates and means of the same conditions."""
    human = study.human
    if name == "collisions":
        return _standardised(human, group)
    if name == "held":
        return Estimate(0.0, len(human.finished))
    if name in WHO_FIRST:
        return _slope(human, name)
    if study.imported and not study.imported.contradicting and _pairs(human) >= MIN_PAIRS:
        return _gap_of_pairs(human, group) if name == "gap" else _gap_slope_of_pairs(human, name)
    return _published_gap(group) if name == "gap" else _published_gap_slope(name)


@cache
def _slope(group: Group, name: str) -> Estimate:
    """A slope of who goes first by Firth's fit, or of the gap with HC3 errors."""
    term, factor, _ = SLOPES[name]
    if name in WHO_FIRST:
        model = penalised(group.outcomes)
        if isinstance(model, str):
            return Estimate(None, len(who_first_data(group.outcomes)[1]), problem=model)
        slope, ci = model.terms.get(term), model.interval(term)
        if slope is None or ci is None:
            return Estimate(None, model.n, problem="no profile of Firth's likelihood converges")
        return Estimate(slope.b, model.n, ci, slope.se)
    fit = fits(group).hc3
    if fit.problem:
        return Estimate(None, fit.n, problem=fit.problem)
    return _by_t(factor * fit.terms[term].b, factor * fit.terms[term].se, fit.freedom, fit.n)


def _by_t(value: float, se: float, freedom: float, n: int, remark: str = "") -> Estimate:
    """An estimate with Student's t."""
    ci = intervals.interval(value, se, freedom)
    return Estimate(value, n, ci, se, freedom, remark=remark)


def _collided(group: Group) -> Estimate:
    """The share of ended trials with a collision by the humans' rule, in percent."""
    k, decided = counts(group, BOXES)
    n = decided + (cut_off := undecided(group, BOXES))
    if not n:
        return Estimate(None, 0, problem=f"no trial ended: {group.left_out}")
    least, most = (_rate((k + more) / n, n, n) for more in (0, cut_off))
    if not cut_off:
        return replace(least, k=k)
    assert least.ci is not None
    assert most.ci is not None
    ends = least.ci[0], most.ci[1]
    note = undecided_note(group, BOXES)
    return Estimate(None, n, ends, problem=note, k=k, undecided=cut_off)


def _rate(rate: float, as_good_as: float, n: int) -> Estimate:
    """A rate in percent with Wilson's interval of so many trials."""
    low, high = wilson(rate, as_good_as)
    return Estimate(100 * rate, n, (100 * low, 100 * high), rate=(rate, as_good_as))


def _standardised(human: Group, group: Group) -> Estimate:
    """The humans' collisions in the conditions of a group, which weigh as they do there."""
    trials = human.outcomes.dropna(subset=[BOXES.column])
    by_condition = trials.astype({BOXES.column: bool}).groupby("condition")[BOXES.column]
    rates, sizes = by_condition.mean(), by_condition.size()
    played = group.ended_outcomes["condition"]  # with those that are undecided
    weights = played.value_counts(normalize=True).reindex(rates.index).dropna()
    if weights.empty:
        return Estimate(None, 0, problem="no human drove its conditions")
    weights /= weights.sum()
    as_good_as = 1 / float((weights**2 / sizes[weights.index]).sum())
    rate = float((weights * rates[weights.index]).sum())
    return _rate(rate, as_good_as, int(sizes[weights.index].sum()))


def _mean(values: np.ndarray, n: int | None = None, remark: str = "") -> Estimate:
    """A mean with Student's t."""
    if len(values) < 2:
        problem = "a single trial has no error" if len(values) else "no trial finished with a gap"
        return Estimate(float(values[0]) if len(values) else None, len(values), problem=problem)
    se = intervals.standard_error(values)
    return _by_t(float(values.mean()), se, len(values) - 1, n or len(values), remark)


def _held(study: Study, group: Group) -> Estimate:
    """How far accelerations are held, less the humans, in human standard deviations (I5)."""
    found = likeness.difference(study, group) if group.measured and len(group.finished) else None
    if found is None or found.value is None:
        why = "too few human recordings are imported" if not study.calibrated else "no trial acted"
        return Estimate(None, len(group.finished), problem=f"I5 is not compared: {why}")
    return Estimate(found.value, found.n, found.bounds())


def _pairs(human: Group) -> int:
    return int(human.finished["pair"].nunique()) if "pair" in human.finished else 0


def _gap_of_pairs(human: Group, group: Group) -> Estimate:
    """The humans' mean gap in the conditions of a group, over the means of their pairs."""
    alike = human.finished["condition"].isin(group.trials["condition"].unique())
    trials = human.finished[alike].dropna(subset=["gap_m"])
    return _mean(trials.groupby("pair")["gap_m"].mean().to_numpy(float), len(trials))


def _published_gap(group: Group) -> Estimate:
    """The published mean of all conditions, with the spread of the nine pairs."""
    row = published("paper_ablation_quantitative").query("driver == 'human'").iloc[0]
    value, se = float(row["gap_m"]), HUMAN_GAP_PAIR_SD_M / len(PAIRS) ** 0.5
    n = int(published("paper_gap").query("driver == 'human'")["n"].iloc[0])
    if {*HUMAN_CONDITIONS} - {*group.trials["condition"]}:
        return Estimate(None, n, problem="the published human gap is that of all 11 conditions")
    return _by_t(value, se, len(PAIRS) - 1, n, "humans as published")


def _gap_slope_of_pairs(human: Group, name: str) -> Estimate:
    term, factor, _ = SLOPES[name]
    fit = by_pairs(gap_ols, human.trials, "gap_m")
    if fit.problem:
        return Estimate(None, fit.n, problem=f"humans: {fit.problem}")
    return _by_t(factor * fit.terms[term].b, factor * fit.terms[term].se, fit.freedom, fit.n)


def _published_gap_slope(name: str) -> Estimate:
    term, factor, _ = SLOPES[name]
    rows = published("paper_gap").query("driver == 'human'").set_index("term")
    row = rows.loc[term]
    n = int(row["n"])
    value, se = factor * float(row["b"]), factor * float(row["se"])
    return _by_t(value, se, n - len(GAP_TERMS), n, "humans as published")
