"""The qualitative indicators I1 to I4: by the paper's rule, and by tests that hold.

I1: merging first becomes likelier with projected headway. I2: and less likely with relative
velocity. I3: the gap grows with the size of the projected headway. I4: it does not depend on the
size of the relative velocity (the main effect alone; arXiv 2604.09609, Table V).

The paper judges signs and p < 0.05 of Wald tests. Human data are nearly separable, where Wald tests
lose their power, and a large p is no evidence of no effect. So I1 and I2 are judged again by
likelihood-ratio tests of Firth's fit, I3 by an HC3 test, and I4 by two one-sided tests
of equivalence (Schuirmann 1987) with HC3 errors.
"""

from __future__ import annotations

from dataclasses import dataclass

from scipy import stats

from analysis.stats.regressions import Regression

ALPHA = 0.05
# Equivalence margin of I4: the effect of the largest dv in the experiment stays within 1 m.
GAP_MARGIN_M = 1.0
LARGEST_VELOCITY_MPS = 0.8
SLOPE_MARGIN_S = GAP_MARGIN_M / LARGEST_VELOCITY_MPS

INDICATORS = {
    "I1": "The probability of merging first increases with projected headway advantage.",
    "I2": "The probability of merging first decreases with relative velocity advantage.",
    "I3": "The safety gap is moderately positively affected by projected headway.",
    "I4": "The safety gap is not affected by initial relative velocity difference.",
    "I5": "Conflicts are resolved with intermittent, piecewise-linear velocity profiles.",
}
TESTED = ("I1", "I2", "I3", "I4")


@dataclass(frozen=True, slots=True)
class Verdict:
    """Whether an indicator holds; None where the data cannot tell, for the reason ``why``."""

    passed: bool | None
    p: float | None = None
    why: str = ""


def paper_verdicts(logit: Regression, ols: Regression) -> dict[str, Verdict]:
    """I1 to I4 by the signs and Wald tests of the paper."""
    return {
        "I1": _signed(logit, "projected_headway", 1),
        "I2": _signed(logit, "relative_velocity", -1),
        "I3": _signed(ols, "abs_projected_headway", 1),
        "I4": _not_significant(ols, "abs_relative_velocity"),
    }


def robust_verdicts(firth: Regression, hc3: Regression) -> dict[str, Verdict]:
    """I1 to I4 by Firth's likelihood-ratio tests, HC3 and equivalence."""
    return {
        "I1": _signed(firth, "projected_headway", 1),
        "I2": _signed(firth, "relative_velocity", -1),
        "I3": _signed(hc3, "abs_projected_headway", 1),
        "I4": _equivalent(hc3, "abs_relative_velocity"),
    }


def equivalence_p(b: float, se: float, freedom: int) -> float:
    """The p-value of |slope| < SLOPE_MARGIN_S, by two one-sided t tests."""
    nearest = SLOPE_MARGIN_S - abs(b)
    return float(stats.t.sf(nearest / se, freedom))


def _signed(fit: Regression, name: str, sign: int) -> Verdict:
    if fit.problem:
        return Verdict(None, None, fit.problem)
    term = fit.terms[name]
    return Verdict(bool(term.b * sign > 0 and term.p < ALPHA), term.p)


def _not_significant(fit: Regression, name: str) -> Verdict:
    if fit.problem:
        return Verdict(None, None, fit.problem)
    return Verdict(fit.terms[name].p >= ALPHA, fit.terms[name].p)


def _equivalent(fit: Regression, name: str) -> Verdict:
    if fit.problem:
        return Verdict(None, None, fit.problem)
    assert fit.freedom is not None
    p = equivalence_p(fit.terms[name].b, fit.terms[name].se, fit.freedom)
    return Verdict(p < ALPHA, p)
