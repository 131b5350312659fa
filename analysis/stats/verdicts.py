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

from merge_runner.scenarios.merge.conditions import HUMAN_CONDITIONS
from merge_runner_analysis.data.reference_data import PAIRS, human_gap_pair_sd_m, published
from merge_runner_analysis.data.study import Group, Study
from merge_runner_analysis.metrics import BOXES, GAP
from merge_runner_analysis.stats import intervals
from merge_runner_analysis.stats.contrasts import corrected, detectable_rate, difference_of_rates
from merge_runner_analysis.stats.group_scores import fits, score
from merge_runner_analysis.stats.indicators import TESTED, Verdict
from merge_runner_analysis.stats.intervals import Difference, Estimate, wilson
from merge_runner_analysis.stats.likeness import less_humans
from merge_runner_analysis.stats.measures import counts, undecided, undecided_note, values
from merge_runner_analysis.stats.regressions import (
    GAP_TERMS,
    MIN_PAIRS,
    Regression,
    Term,
    by_pairs,
    gap_ols,
    who_first_firth,
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

# By measure: the indicator that tests it.
SLOPES = {"headway": "I1", "velocity": "I2", "gap-headway": "I3", "gap-velocity": "I4"}
WHO_FIRST = ("headway", "velocity")
# Relative velocities of the conditions are 0 or so many m/s: what it does to the gap there.
VELOCITY_MPS = 0.8
PUBLISHED = "humans as published"


@dataclass(frozen=True, slots=True)
class Known:
    """What is known of a measure: an estimate, why there is no value, and what to know of it.

    A rate counts ``k`` trials; with ``undecided`` ones it has no value, and its interval holds
    whether none or all of them count (Manski 1989).
    """

    estimate: Estimate
    problem: str = ""
    remark: str = ""
    k: int | None = None
    undecided: int = 0


@dataclass(frozen=True, slots=True)
class Comparison:
    """A driver beside the humans in one measure; ``p_holm`` is corrected over its measures."""

    measure: Measure
    own: Known
    human: Known
    difference: Difference | None
    state: str
    note: str
    p_holm: float | None = None


@cache
def compared(study: Study, group: Group) -> tuple[Comparison, ...]:
    """Compare a driver with the humans by every measure."""
    # Conditions that no human drove would pass for another behaviour.
    alike = group
    if not group.trials["condition"].isin(HUMAN_CONDITIONS).all():
        alike = group.part(lambda trials: trials["condition"].isin(HUMAN_CONDITIONS))
    robust = score(study, alike).robust
    found = [
        _compared(study, alike, measure, robust.get(SLOPES.get(measure.name, "")))
        for measure in MEASURES.values()
    ]
    holm = iter(corrected([one.difference.p for one in found if one.difference]))
    return tuple(replace(one, p_holm=next(holm) if one.difference else None) for one in found)


@cache
def of_humans(study: Study) -> dict[str, Known]:
    """The humans by measure, over all conditions."""
    return {name: _human(study, study.human, name) for name in MEASURES}


def _compared(study: Study, group: Group, measure: Measure, verdict: Verdict | None) -> Comparison:
    own, human = _own(study, group, measure.name), _human(study, group, measure.name)
    if measure.name == "collisions":
        difference = _of_rates(own, human)
    elif measure.name in WHO_FIRST:
        difference = _of_slopes(group, study.human, measure.name)
    else:
        difference = intervals.difference(own.estimate, human.estimate)
    state = _state(measure, own, human.estimate, difference, verdict)
    notes = [own.problem, human.problem]
    if verdict and verdict.passed is None and not own.problem:
        notes.append(verdict.why)
    return Comparison(measure, own, human, difference, state, "; ".join(filter(None, notes)))


def _state(
    measure: Measure,
    own: Known,
    human: Estimate,
    difference: Difference | None,
    verdict: Verdict | None,
) -> str:
    """The state of a measure, empty where it cannot be judged; see ``Measure.rule``."""
    value, ends = own.estimate.value, own.estimate.bounds()
    if ends is None or (value is None and not own.undecided):
        return ""
    if measure.margin is not None:
        low, high = ends
        if verdict.passed if verdict else max(-low, high) < measure.margin:
            return SHOWN
        return UNLIKE if max(low, -high) > measure.margin else OPEN
    if difference is None or human.value is None or (verdict and verdict.passed is None):
        return ""
    low, high = difference.bounds() or ends
    differs = not low <= 0 <= high
    if verdict is None or not verdict.passed:
        return UNLIKE if differs else OPEN
    if not differs:
        return SHOWN
    return WEAKER if abs(value or 0.0) < abs(human.value) else STRONGER


def _of_slopes(group: Group, human: Group, name: str) -> Difference | None:
    """How a slope of who goes first differs, by Firth's fit of one model of both."""
    term, _ = TESTED[SLOPES[name]]
    fit = who_first_firth(group.outcomes, less=human.outcomes)
    ends = fit.interval(term) if fit.terms else None
    if ends is None:
        return None
    slope = fit.terms[term]
    return Difference(slope.b, *ends, slope.p, intervals.detectable(slope.se))


def _of_rates(own: Known, human: Known) -> Difference | None:
    """How two rates differ, in percent.

    With undecided trials it is that of both worst cases: the value nearer to 0, and the larger p.
    """
    n, humans = own.estimate.n, human.estimate
    if own.k is None or humans.value is None or humans.weight is None:
        return None
    rate = humans.value / 100
    cases = [
        difference_of_rates([((own.k + more) / n, n), (rate, humans.weight)])
        for more in (0, own.undecided)
    ]
    (low, _), (_, high) = (case.bounds(100) or (0.0, 0.0) for case in cases)
    value = min((case.value for case in cases), key=abs)
    least = detectable_rate(n, humans.n, rate)
    p = max(case.p for case in cases)
    return Difference(100 * value, low, high, p, None if least is None else 100 * least)


def _own(study: Study, group: Group, name: str) -> Known:
    """A driver's estimate, of its trials in the humans' conditions."""
    if name == "collisions":
        return _collided(group)
    if name == "held":
        return _held(study, group)
    if name in WHO_FIRST:
        return _slope(group, name)
    if name == "gap":
        found = intervals.mean(values(group, GAP).to_numpy(float))
        problem = "a single trial has no error" if found.n else "no trial finished with a gap"
        return Known(found, problem if found.se is None else "")
    return _gap_slope(fits(group).hc3, name)


def _human(study: Study, group: Group, name: str) -> Known:
    """The humans' estimate beside a group's: rates and means of the same conditions."""
    human = study.human
    if name == "collisions":
        return _standardised(human, group)
    if name == "held":
        return Known(Estimate(0.0, None, None, len(human.finished)))
    if name in WHO_FIRST:
        return _slope(human, name)
    pairs = human.finished["pair"].nunique() if "pair" in human.finished else 0
    if study.imported is None or study.imported.contradicting or pairs < MIN_PAIRS:
        return _published_gap(group) if name == "gap" else _published_gap_slope(name)
    if name == "gap":
        alike = human.finished["condition"].isin(group.trials["condition"].unique())
        trials = human.finished[alike].dropna(subset=["gap_m"])
        found = intervals.mean(trials.groupby("pair")["gap_m"].mean().to_numpy(float))
        return Known(replace(found, n=len(trials)))
    return _gap_slope(by_pairs(gap_ols, human.trials, "gap_m"), name, "humans: ")


@cache
def _slope(group: Group, name: str) -> Known:
    """A slope of who goes first by Firth's fit."""
    fit, (term, _) = fits(group).firth, TESTED[SLOPES[name]]
    ends = fit.interval(term) if fit.terms else None
    if ends is None:
        problem = fit.problem or "no profile of Firth's likelihood converges"
        return Known(Estimate(None, None, None, fit.n), problem)
    return Known(Estimate(fit.terms[term].b, *ends, fit.n, fit.terms[term].se))


def _gap_slope(fit: Regression, name: str, whose: str = "") -> Known:
    """A slope of the gap, on relative velocity what that of the conditions does."""
    if fit.problem:
        return Known(Estimate(None, None, None, fit.n), whose + fit.problem)
    term = fit.terms[TESTED[SLOPES[name]][0]]
    factor = VELOCITY_MPS if name == "gap-velocity" else 1.0
    return Known(intervals.estimate(factor * term.b, factor * term.se, fit.freedom, fit.n))


def _published_gap_slope(name: str) -> Known:
    rows = published("paper_gap").query("driver == 'human'")
    terms = {row.term: Term(float(row.b), float(row.se), None, 1.0) for row in rows.itertuples()}
    n = int(rows["n"].iloc[0])
    fit = Regression(n, terms, freedom=n - len(GAP_TERMS))
    return replace(_gap_slope(fit, name), remark=PUBLISHED)


def _published_gap(group: Group) -> Known:
    """The published mean of all conditions, with the spread of the nine pairs."""
    row = published("paper_ablation_quantitative").query("driver == 'human'").iloc[0]
    n = int(published("paper_gap").query("driver == 'human'")["n"].iloc[0])
    if {*HUMAN_CONDITIONS} - {*group.trials["condition"]}:
        problem = "the published human gap is that of all 11 conditions"
        return Known(Estimate(None, None, None, n), problem)
    se = human_gap_pair_sd_m() / len(PAIRS) ** 0.5
    found = intervals.estimate(float(row["gap_m"]), se, len(PAIRS) - 1, n)
    return Known(found, remark=PUBLISHED)


def _collided(group: Group) -> Known:
    """The share of ended trials with a collision by the humans' rule, in percent."""
    k, decided = counts(group, BOXES)
    n = decided + (cut_off := undecided(group, BOXES))
    if not n:
        return Known(Estimate(None, None, None, 0), f"no trial ended: {group.left_out}")
    (low, _), (_, high) = (wilson((k + more) / n, n) for more in (0, cut_off))
    value = None if cut_off else 100 * k / n
    found = Estimate(value, 100 * low, 100 * high, n, weight=n)
    return Known(found, undecided_note(group, BOXES), k=k, undecided=cut_off)


def _standardised(human: Group, group: Group) -> Known:
    """The humans' collisions in the conditions of a group, which weigh as they do there."""
    trials = human.outcomes.dropna(subset=[BOXES.column])
    by_condition = trials.astype({BOXES.column: bool}).groupby("condition")[BOXES.column]
    rates, sizes = by_condition.mean(), by_condition.size()
    played = group.ended_outcomes["condition"]  # with those that are undecided
    weights = played.value_counts(normalize=True).reindex(rates.index).dropna()
    if weights.empty:
        return Known(Estimate(None, None, None, 0), "no human drove its conditions")
    weights /= weights.sum()
    as_good_as = 1 / float((weights**2 / sizes[weights.index]).sum())
    rate, n = float((weights * rates[weights.index]).sum()), int(sizes[weights.index].sum())
    low, high = wilson(rate, as_good_as)
    return Known(Estimate(100 * rate, 100 * low, 100 * high, n, weight=as_good_as))


def _held(study: Study, group: Group) -> Known:
    """How far accelerations are held, less the humans, in human standard deviations (I5)."""
    found = less_humans(study, group) if group.measured and len(group.finished) else None
    if found is None or found.value is None:
        why = "too few human recordings are imported" if not study.calibrated else "no trial acted"
        nothing = Estimate(None, None, None, len(group.finished))
        return Known(nothing, f"I5 is not compared: {why}")
    return Known(found)
