"""The qualitative indicators I1 to I4: by the paper's rule, and by tests that hold.

I1: merging first becomes likelier with projected headway. I2: and less likely with relative
velocity. I3: the gap grows with the size of the projected headway. I4: it does not depend on the
relative velocity (arXiv 2604.09609, Table V).

The paper judges signs and p < 0.05 of Wald tests, I4 by the main effect of |dv| alone. Human data
are nearly separable, where Wald tests lose their power, and a large p is no evidence of no effect.
So I1 and I2 are judged again by likelihood-ratio tests of Firth's fit, I3 by an HC3 test, and I4 by
what all terms with relative velocity predict together: of any two played conditions that differ in
relative velocity alone, the gaps are less than a margin apart. The signed product h dv of the
paper's own regression (its eq. 2) tells a vehicle that is ahead and faster from one that is ahead
and slower, so that no further term is needed. Each difference is tested by two one-sided tests
(Schuirmann 1987) with HC3 errors; all of them must pass, which needs no correction for their number
(an intersection-union test; Berger 1982).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

from scipy import stats

from merge_runner_analysis.stats.regressions import WHO_FIRST_TERMS, Regression, Term, VelocityPair

ALPHA = 0.05
# Equivalence margin of I4: how far relative velocity alone may move the gap.
GAP_MARGIN_M = 1.0
# Instead of a term: the differences ``Regression.apart``.
APART = "apart"
NONE_APART = "no two played conditions differ in relative velocity alone"

INDICATORS = {
    "I1": "The probability of merging first increases with projected headway advantage.",
    "I2": "The probability of merging first decreases with relative velocity advantage.",
    "I3": "The safety gap is moderately positively affected by projected headway.",
    "I4": "The safety gap is not affected by initial relative velocity difference.",
    "I5": "Conflicts are resolved with intermittent, piecewise-linear velocity profiles.",
}


def equivalence_p(b: float, se: float, freedom: float) -> float:
    """The p-value of |difference| < GAP_MARGIN_M, by two one-sided t tests (Schuirmann 1987).

    It is the larger of the two, that against the nearer margin. A difference without an error, as
    of a driver without spread, is sure: it lies within the margin or it does not.
    """
    inside = GAP_MARGIN_M - abs(b)
    if se == 0:
        return float(inside <= 0)
    return float(stats.t.sf(inside / se, freedom))


def _increases(term: Term, freedom: float) -> bool:
    return term.b > 0 and term.p < ALPHA


def _decreases(term: Term, freedom: float) -> bool:
    return term.b < 0 and term.p < ALPHA


@dataclass(frozen=True, slots=True)
class Criterion:
    """Which term decides an indicator, and whether it ``holds``; of APART each difference has to.

    ``holds`` takes the term and the degrees of freedom of its fit.
    """

    term: str
    holds: Callable[[Term, float], bool]

    @property
    def of_who_first(self) -> bool:
        """Whether it is a term of the regression of who merges first, and not of the gap's."""
        return self.term in WHO_FIRST_TERMS


PAPER = {
    "I1": Criterion("projected_headway", _increases),
    "I2": Criterion("relative_velocity", _decreases),
    "I3": Criterion("abs_projected_headway", _increases),
    "I4": Criterion("abs_relative_velocity", lambda term, _: term.p >= ALPHA),
}
# The same rules for better tests; only I4 differs: a large p shows nothing, so that the absence
# of an effect has to be shown.
ROBUST = PAPER | {
    "I4": Criterion(APART, lambda term, freedom: equivalence_p(term.b, term.se, freedom) < ALPHA)
}
TESTED = tuple(PAPER)


@dataclass(frozen=True, slots=True)
class Verdict:
    """Whether an indicator holds; None where the data cannot tell, for the reason ``why``."""

    passed: bool | None
    why: str = ""


def disagree(one: Verdict, other: Verdict) -> bool:
    """Whether one says that an indicator holds and the other that it does not."""
    return None not in {one.passed, other.passed} and one.passed != other.passed


def verdicts(
    criteria: Mapping[str, Criterion], who_first: Regression, gap: Regression
) -> dict[str, Verdict]:
    """I1 to I4 by these criteria; ROBUST ones need Firth's fit and HC3 errors."""
    return {
        name: judged(criterion, who_first if criterion.of_who_first else gap)
        for name, criterion in criteria.items()
    }


def judged(criterion: Criterion, fit: Regression) -> Verdict:
    """The verdict on one fit."""
    if fit.problem:
        return Verdict(None, fit.problem)
    if criterion.term == APART and not fit.apart:
        return Verdict(None, NONE_APART)
    tested = fit.apart.values() if criterion.term == APART else [fit.terms[criterion.term]]
    return Verdict(all(criterion.holds(term, fit.freedom) for term in tested))


def furthest_apart(fit: Regression) -> VelocityPair:
    """Of the differences ``fit.apart`` the one that I4 fails by first."""
    return max(
        fit.apart,
        key=lambda pair: (
            equivalence_p(fit.apart[pair].b, fit.apart[pair].se, fit.freedom),
            abs(fit.apart[pair].b),
        ),
    )
