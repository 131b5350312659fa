"""The verdicts on hand-made regressions."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np
import pandas as pd
import pytest
from scipy import stats

from merge_runner.scenarios.merge.conditions import CONDITIONS
from merge_runner_analysis.stats.indicators import (
    INDICATORS,
    NONE_APART,
    Verdict,
    total,
    verdicts,
)
from merge_runner_analysis.stats.regressions import (
    GAP_MARGIN_M,
    Regression,
    Term,
    equivalence_p,
    gap_design,
    gap_ols,
)

SEPARATED = "separation: no finite estimate of projected_headway; see Firth's fit"
MISSING = Regression(0, {}, "no finished trial with a gap")
paper_verdicts = partial(verdicts, robust=False)
robust_verdicts = partial(verdicts, robust=True)
BOTH = pytest.mark.parametrize("by_rule", [paper_verdicts, robust_verdicts])


def who_first(headway=(1.0, 0.001), velocity=(-3.0, 0.001)) -> Regression:
    """A fit of who merges first; (b, p) of its slopes."""
    terms = {"intercept": (0.0, 0.5), "projected_headway": headway, "relative_velocity": velocity}
    return Regression(110, {name: Term(b, 0.1, None, p) for name, (b, p) in terms.items()})


def gap(headway=(0.2, 0.001), velocity=(0.0, 0.9), product=(0.0, 0.9), se=0.2) -> Regression:
    """A fit of the gap; (b, p) of its slopes, whose errors are taken as independent.

    Two conditions level with each other were played, and two where the left is 4 m ahead.
    """
    terms = {
        "intercept": (4.0, 0.001),
        "abs_projected_headway": headway,
        "abs_relative_velocity": velocity,
        "headway_x_velocity": product,
    }
    fitted = {name: Term(b, se, b / se, p) for name, (b, p) in terms.items()}
    tests = []
    for h, *velocities in ((0.0, 0.8, 0.0), (4.0, 0.8, -0.8)):
        one, other = (gap_design(np.array([h]), np.array([dv]))[0] for dv in velocities)
        b = float((one - other) @ [term.b for term in fitted.values()])
        tests.append(equivalence_p(b, se * float(np.linalg.norm(one - other)), 106))
    return Regression(110, fitted, freedom=106, equivalence_p=max(tests))


@BOTH
@pytest.mark.parametrize(
    ("b", "p", "i1", "i2", "i3"),
    [
        (1.0, 0.001, True, False, True),
        (-1.0, 0.001, False, True, False),
        (1.0, 0.049, True, False, True),
        (1.0, 0.05, False, False, False),
        (-1.0, 0.05, False, False, False),
        (1.0, 0.3, False, False, False),
        (0.0, 0.001, False, False, False),
    ],
)
def test_i1_to_i3_need_their_sign_and_p_below_5_percent(by_rule, b, p, i1, i2, i3):
    found = by_rule(who_first((b, p), (b, p)), gap((b, p)))
    assert [found[name] for name in ("I1", "I2", "I3")] == [
        Verdict(passed) for passed in (i1, i2, i3)
    ]


@BOTH
@pytest.mark.parametrize("open_one", ["I1", "I2", "I3", "I4"])
def test_each_indicator_reads_its_own_term(by_rule, open_one):
    p = {"I1": 0.011, "I2": 0.012, "I3": 0.013, open_one: 0.5}
    velocity = (3.0, 0.001) if open_one == "I4" else (0.0, 0.9)
    of_gap = gap((1.0, p["I3"]), velocity, se=0.05)
    found = by_rule(who_first((1.0, p["I1"]), (-1.0, p["I2"])), of_gap)
    assert list(found) == ["I1", "I2", "I3", "I4"]
    assert [name for name, verdict in found.items() if not verdict.passed] == [open_one]


@pytest.mark.parametrize(
    ("p", "passed"), [(0.001, False), (0.049, False), (0.05, True), (0.9, True)]
)
def test_i4_holds_by_the_paper_where_the_effect_is_not_significant(p, passed):
    for b in (-1.0, 1.0):
        assert paper_verdicts(who_first(), gap(velocity=(b, p)))["I4"] == Verdict(passed)


def test_i4_looks_at_the_main_effect_alone_by_the_paper_and_at_all_terms_by_the_robust_test():
    """The product is significant for the humans of the paper, and they have the mark."""
    humans = gap(velocity=(-0.2, 0.236), product=(0.06, 0.031), se=0.03)
    assert paper_verdicts(who_first(), humans)["I4"].passed is True
    assert robust_verdicts(who_first(), humans)["I4"].passed is True
    depends = gap(velocity=(-0.2, 0.236), product=(0.2, 0.031), se=0.03)
    assert paper_verdicts(who_first(), depends)["I4"].passed is True
    assert robust_verdicts(who_first(), depends)["I4"].passed is False


# Of the driver idm, in each of the 11 conditions: it has no spread.
IDM_GAPS_M = {
    "N_0_0": 18.375,
    "L_0_-8": 18.023,
    "R_0_8": 18.023,
    "L_2_-8": 17.060,
    "R_-2_8": 17.060,
    "L_4_0": 17.973,
    "R_-4_0": 17.973,
    "L_4_-8": 17.048,
    "R_-4_8": 17.048,
    "L_4_8": 19.134,
    "R_-4_-8": 19.134,
}


def trials_of(gaps_m) -> pd.DataFrame:
    columns = ["projected_headway_m", "relative_velocity_mps", "status", "gap_m"]
    return pd.DataFrame(
        [
            (CONDITIONS[name].projected_headway_m, CONDITIONS[name].relative_velocity_mps,
             "finished", gap_m)
            for name, gap_m in gaps_m.items()
        ],
        columns=columns,
    )  # fmt: skip


def test_a_gap_that_depends_on_who_is_ahead_and_faster_fails_i4():
    trials = trials_of(IDM_GAPS_M)
    fit = gap_ols(trials, robust=True)
    assert paper_verdicts(who_first(), gap_ols(trials))["I4"] == Verdict(True)
    assert robust_verdicts(who_first(), fit)["I4"] == Verdict(False)
    assert fit.equivalence_p > 0.95
    assert fit.velocity_p < 0.001


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize(("slope", "passed"), [(0.15, True), (0.16, False)])
def test_gaps_without_spread_are_compared_with_the_margin_themselves(slope, passed):
    """They lie on the regression: a slope of 1 / 6.4 of the product is 1 m."""
    gaps_m = {name: 5 + slope * c.projected_headway_m * c.relative_velocity_mps
              for name, c in CONDITIONS.items()}  # fmt: skip
    fit = gap_ols(trials_of(gaps_m), robust=True)
    assert robust_verdicts(who_first(), fit)["I4"] == Verdict(passed)
    assert fit.velocity_p is None or fit.velocity_p < 0.001
    for b in (0.0, 0.999, -0.999):
        assert equivalence_p(b, 0.0, 9) == 0
    for b in (1.0, -1.0, 2.0):
        assert equivalence_p(b, 0.0, 9) == 1


@pytest.mark.filterwarnings("error")
def test_terms_whose_errors_hang_together_have_no_joint_test():
    """Gaps vary in N_0_0 alone: one number says the errors of all coefficients."""
    rest = {name: 5 + 0.2 * abs(c.projected_headway_m) for name, c in CONDITIONS.items()}
    level = [trials_of({"N_0_0": gap_m}) for gap_m in (4.0, 6.0)]
    fit = gap_ols(pd.concat([trials_of(rest), *level]), robust=True)
    assert fit.velocity_p is None
    assert robust_verdicts(who_first(), fit)["I4"].passed is not None


def test_gaps_that_do_not_vary_leave_nothing_to_test():
    found = gap_ols(trials_of(dict.fromkeys(CONDITIONS, 3.85)), robust=True)
    assert "less than 1 cm" in robust_verdicts(who_first(), found)["I4"].why


def test_differences_are_of_played_conditions_with_one_projected_headway():
    """Without the pairs of 1.6 m/s at 4 m only differences of 0.8 m/s are left, which are small."""
    rng = np.random.default_rng(5)
    gaps_m = {
        name: 5 + 0.3 * c.projected_headway_m * c.relative_velocity_mps
        for name, c in CONDITIONS.items()
    }
    some = {name: m for name, m in gaps_m.items() if name not in {"L_4_8", "R_-4_-8"}}
    for played, holds in ((gaps_m, False), (some, True)):
        trials = pd.concat([trials_of(played)] * 20)
        trials["gap_m"] += rng.normal(0, 0.01, len(trials))
        fit = gap_ols(trials, robust=True)
        assert robust_verdicts(who_first(), fit)["I4"] == Verdict(holds)


def test_without_conditions_that_differ_in_relative_velocity_alone_i4_is_not_judged():
    fit = replace(gap(), equivalence_p=None)
    assert robust_verdicts(who_first(), fit)["I4"] == Verdict(None, NONE_APART)
    assert paper_verdicts(who_first(), fit)["I4"].passed is True


@pytest.mark.parametrize("b", [-2.0, -1.0, -0.8, -0.3, 0.0, 0.3, 0.8, 1.0, 2.0])
@pytest.mark.parametrize("freedom", [3, 106])
def test_equivalence_is_the_larger_p_of_two_one_sided_t_tests(b, freedom):
    se = 0.4
    not_below = stats.t.sf((b + GAP_MARGIN_M) / se, freedom)  # against at most -1 m
    not_above = stats.t.cdf((b - GAP_MARGIN_M) / se, freedom)  # against at least 1 m
    assert equivalence_p(b, se, freedom) == pytest.approx(max(not_below, not_above))


def test_equivalence_at_the_margin_is_a_coin_toss():
    assert equivalence_p(1.0, 0.3, 50) == equivalence_p(-1.0, 0.3, 50) == 0.5


@pytest.mark.parametrize("sign", [-1, 1])
def test_i4_holds_robustly_where_the_effect_is_shown_to_be_small(sign):
    quantile = stats.t.isf(0.05, 106)
    for se in (0.02, 0.05):
        edge = 1.25 - quantile * se  # of a slope that is multiplied by 0.8 m/s
        inside = robust_verdicts(who_first(), gap(velocity=(sign * (edge - 0.01), 0.5), se=se))
        outside = robust_verdicts(who_first(), gap(velocity=(sign * (edge + 0.01), 0.5), se=se))
        assert (inside["I4"].passed, outside["I4"].passed) == (True, False)


def test_a_large_p_alone_shows_no_equivalence():
    vague = gap(velocity=(0.1, 0.9), se=1.0)
    assert paper_verdicts(who_first(), vague)["I4"].passed is True
    assert robust_verdicts(who_first(), vague)["I4"].passed is False


def test_a_separated_fit_is_neither_a_pass_nor_a_failure_of_i1_and_i2():
    found = paper_verdicts(Regression(110, {}, SEPARATED), gap())
    assert found["I1"] == found["I2"] == Verdict(None, SEPARATED)
    assert found["I3"].passed is True


def test_a_score_counts_only_what_can_be_judged():
    found = total(paper_verdicts(Regression(110, {}, SEPARATED), gap((0.2, 0.2))))
    assert found == "1 of 2"
    assert total({"I1": Verdict(None, "too few")}) is None


@BOTH
def test_a_fit_that_is_missing_leaves_its_indicators_open(by_rule):
    nobody = Regression(0, {}, "no finished trial with a first merger")
    found = by_rule(nobody, gap(se=0.05))
    assert found["I1"] == found["I2"] == Verdict(None, nobody.problem)
    assert (found["I3"].passed, found["I4"].passed) == (True, True)
    found = by_rule(who_first(), MISSING)
    assert found["I3"] == found["I4"] == Verdict(None, MISSING.problem)
    assert (found["I1"].passed, found["I2"].passed) == (True, True)


def test_every_indicator_is_described():
    assert list(INDICATORS) == ["I1", "I2", "I3", "I4", "I5"]
