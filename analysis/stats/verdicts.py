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

from merge_runner.scenarios.merge.conditions import HUMAN_CONDITIONS
from merge_runner_analysis.data.reference_data import PAIRS, published
from merge_runner_analysis.data.remember import remembered
from merge_runner_analysis.data.study import Group, Study
from merge_runner_analysis.metrics import BOXES, GAP
from merge_runner_analysis.stats import intervals
from merge_runner_analysis.stats.contrasts import (
    corrected,
    detectable_rate,
    difference_of_rates,
    weighted,
)
from merge_runner_analysis.stats.indicators import (
    TESTED,
    Verdict,
    fits,
    less_humans,
    mean_over,
    score,
)
from merge_runner_analysis.stats.intervals import NOTHING, Difference, Estimate, wilson
from merge_runner_analysis.stats.measures import (
    counts,
    estimate,
    undecided,
    undecided_note,
)
from merge_runner_analysis.stats.regressions import (
    MIN_PAIRS,
    Regression,
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


@remembered
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


@remembered
def of_humans(study: Study) -> dict[str, Known]:
    """The humans by measure, over all conditions."""
    return {name: _human(study, study.human, name) for name in MEASURES}


def _compared(study: Study, group: Group, measure: Measure, verdict: Verdict | None) -> Comparison:
    own, human = _own(study, group, measure.name), _human(study, group, measure.name)
    if measure.name == "collisions":
        difference = _of_rates(own, human)
    elif measure.name in WHO_FIRST:
        # One model of both, in which every term may differ.
        less = who_first_firth(group.outcomes, less=study.human.outcomes)
        difference = less.difference(TESTED[SLOPES[measure.name]][0])
    else:
        difference = intervals.difference(own.estimate, human.estimate)
    state = _state(measure, own, human.estimate, difference, verdict)
    why = verdict.why if verdict and verdict.passed is None and not own.problem else ""
    note = "; ".join(filter(None, (own.problem, human.problem, why)))
    return Comparison(measure, own, human, difference, state, note)


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
        inside = verdict.passed if verdict else max(-low, high) < measure.margin
        return SHOWN if inside else UNLIKE if max(low, -high) > measure.margin else OPEN
    if difference is None or human.value is None or (verdict and verdict.passed is None):
        return ""
    low, high = difference.bounds() or ends
    differs = not low <= 0 <= high
    if verdict is None or not verdict.passed:
        return UNLIKE if differs else OPEN
    weaker = abs(value or 0.0) < abs(human.value)
    return (WEAKER if weaker else STRONGER) if differs else SHOWN


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
    if name in WHO_FIRST:
        return _slope(group, name)
    if name == "gap":
        return _gap(group, group)
    if name != "held":
        return _gap_slope(fits(group).hc3, name)
    # I5: how far accelerations are held, less the humans, in human standard deviations.
    likeness = less_humans(study, group) if len(group.finished) else None
    if likeness is not None and likeness.value is not None:
        return Known(likeness)
    why = "no trial acted" if study.calibrated else "too few human recordings are imported"
    return Known(replace(NOTHING, n=len(group.finished)), f"I5 is not compared: {why}")


def _human(study: Study, group: Group, name: str) -> Known:
    """The humans' estimate beside a group's: rates and means of the same conditions."""
    human = study.human
    if name == "collisions":
        return _standardised(human, group)
    if name == "held":
        return Known(Estimate(0.0, None, None, len(human.finished)))
    if name in WHO_FIRST:
        return _slope(human, name)
    if not human.measured or human.finished["pair"].nunique() < MIN_PAIRS:
        return _published(group, name)
    if name == "gap":
        return _gap(human, group)
    return _gap_slope(by_pairs(gap_ols, human.trials, "gap_m"), name, "humans: ")


def _gap(group: Group, like: Group) -> Known:
    """The mean gap of a group in the conditions of another one."""
    alike = group.finished["condition"].isin(like.trials["condition"])
    found = mean_over(group.finished[alike].dropna(subset=[GAP.column]), GAP.column)
    problem = "a single trial has no error" if found.n else "no trial finished with a gap"
    return Known(found, problem if found.se is None else "")


@remembered
def _slope(group: Group, name: str) -> Known:
    """A slope of who goes first by Firth's fit."""
    fit = fits(group).firth
    found = fit.difference(TESTED[SLOPES[name]][0])
    if found is None:
        problem = fit.problem or "no profile of Firth's likelihood converges"
        return Known(replace(NOTHING, n=fit.n), problem)
    return Known(Estimate(found.value, found.low, found.high, fit.n, found.se))


def _gap_slope(fit: Regression, name: str, whose: str = "") -> Known:
    """A slope of the gap, on relative velocity what that of the conditions does."""
    if fit.problem:
        return Known(replace(NOTHING, n=fit.n), whose + fit.problem)
    term = fit.terms[TESTED[SLOPES[name]][0]]
    return Known(_at_its_velocity(name, term.b, term.se, fit.freedom, fit.n))


def _at_its_velocity(name: str, b: float, se: float, freedom: float, n: int) -> Estimate:
    factor = VELOCITY_MPS if name == "gap-velocity" else 1.0
    return intervals.estimate(factor * b, factor * se, freedom, n)


def _published(group: Group, name: str) -> Known:
    """The published gap: its regression, or its mean over all conditions.

    The mean has the spread of the nine pairs: of their random intercepts, which are shrunken, so
    that it is rather too small.
    """
    rows = published("paper_gap").query("driver == 'human'")
    n = int(rows["n"].iloc[0])
    if name != "gap":
        row = rows.set_index("term").loc[TESTED[SLOPES[name]][0]]
        b, se = float(row["b"]), float(row["se"])
        return Known(_at_its_velocity(name, b, se, n - len(rows), n), remark=PUBLISHED)
    if {*HUMAN_CONDITIONS} - {*group.trials["condition"]}:
        problem = "the published human gap is that of all 11 conditions"
        return Known(replace(NOTHING, n=n), problem)
    mean = published("paper_ablation_quantitative").query("driver == 'human'")["gap_m"].iloc[0]
    se = published("human_gap_intercepts")["intercept_m"].std() / len(PAIRS) ** 0.5
    found = intervals.estimate(float(mean), float(se), len(PAIRS) - 1, n)
    return Known(found, remark=PUBLISHED)


def _collided(group: Group) -> Known:
    """The share of ended trials with a collision by the humans' rule, in percent."""
    (k, decided), cut_off = counts(group, BOXES), undecided(group, BOXES)
    if not (n := decided + cut_off):
        return Known(NOTHING, f"no trial ended: {group.left_out}")
    found = replace(estimate(group, BOXES), n=n, weight=n)
    return Known(found, undecided_note(group, BOXES), k=k, undecided=cut_off)


def _standardised(human: Group, group: Group) -> Known:
    """The humans' collisions in the conditions of a group, which weigh as they do there."""
    played = group.ended_outcomes["condition"].value_counts()  # with those that are undecided
    there = human.outcomes[human.outcomes["condition"].isin(played.index)]
    if there.empty:
        return Known(NOTHING, "no human drove its conditions")
    humans = there.groupby("condition")[BOXES.column].agg(["sum", "size"]).astype(int)
    k, n = humans.to_numpy().T
    rate, as_good_as = weighted(k, n, played[humans.index].to_numpy(float))
    low, high = wilson(rate, as_good_as)
    return Known(Estimate(100 * rate, 100 * low, 100 * high, len(there), weight=as_good_as))
