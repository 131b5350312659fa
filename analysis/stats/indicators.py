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

from dataclasses import dataclass

from merge_runner_analysis.stats.regressions import Regression

ALPHA = 0.05
NONE_APART = "no two played conditions differ in relative velocity alone"
INDICATORS = {
    "I1": "The probability of merging first increases with projected headway advantage.",
    "I2": "The probability of merging first decreases with relative velocity advantage.",
    "I3": "The safety gap is moderately positively affected by projected headway.",
    "I4": "The safety gap is not affected by initial relative velocity difference.",
    "I5": "Conflicts are resolved with intermittent, piecewise-linear velocity profiles.",
}
# By indicator: the term that decides it, and the sign that it needs; I4's is to have no effect.
TESTED = {
    "I1": ("projected_headway", 1),
    "I2": ("relative_velocity", -1),
    "I3": ("abs_projected_headway", 1),
    "I4": ("abs_relative_velocity", 0),
}


@dataclass(frozen=True, slots=True)
class Verdict:
    """Whether an indicator holds; None where the data cannot tell, for the reason ``why``."""

    passed: bool | None
    why: str = ""


def disagree(one: Verdict, other: Verdict) -> bool:
    """Whether one says that an indicator holds and the other that it does not."""
    return None not in {one.passed, other.passed} and one.passed != other.passed


def verdicts(who_first: Regression, gap: Regression, *, robust: bool) -> dict[str, Verdict]:
    """I1 to I4 by the paper's rule, or by the ``robust`` one, for Firth's fit and HC3 errors."""
    return {
        name: _judged(who_first if name in {"I1", "I2"} else gap, name, robust=robust)
        for name in TESTED
    }


def _judged(fit: Regression, name: str, *, robust: bool) -> Verdict:
    if fit.problem:
        return Verdict(None, fit.problem)
    name_of_term, sign = TESTED[name]
    term = fit.terms[name_of_term]
    if sign:
        return Verdict(sign * term.b > 0 and term.p < ALPHA)
    if not robust:
        return Verdict(term.p >= ALPHA)
    if fit.equivalence_p is None:
        return Verdict(None, NONE_APART)
    return Verdict(fit.equivalence_p < ALPHA)
