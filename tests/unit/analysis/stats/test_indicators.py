"""The verdicts on hand-made regressions."""

from dataclasses import replace
from functools import partial

import numpy as np
import pandas as pd
import pytest
from scipy import stats

from merge_runner.scenarios.merge.conditions import CONDITIONS
from merge_runner_analysis.facts import Fact, Why
from merge_runner_analysis.stats.indicators import Judgement, judge, total
from merge_runner_analysis.stats.regressions import (
    GAP_MARGIN_M,
    Regression,
    Term,
    equivalence_p,
    gap_design,
    gap_ols,
)

SEPARATED = Regression(110, {}, Fact(Why.SEPARATION, ("projected_headway",)))
MISSING = Regression(0, {}, Fact(Why.NO_GAP))
paper_verdicts = partial(judge, robust=False)
robust_verdicts = partial(judge, robust=True)
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
    ("b", "p", "passed"),
    [
        (1.0, 0.001, [True, False, True]),
        (-1.0, 0.001, [False, True, False]),
        (1.0, 0.049, [True, False, True]),
        (1.0, 0.05, [False] * 3),
        (-1.0, 0.05, [False] * 3),
        (0.0, 0.001, [False] * 3),
    ],
)
def test_i1_to_i3_need_their_sign_and_p_below_5_percent(by_rule, b, p, passed):
    found = by_rule(who_first((b, p), (b, p)), gap((b, p)))
    assert [found[name] for name in ("I1", "I2", "I3")] == [*map(Judgement, passed)]


@BOTH
@pytest.mark.parametrize("open_one", ["I1", "I2", "I3", "I4"])
def test_each_indicator_reads_its_own_term(by_rule, open_one):
    p = {"I1": 0.011, "I2": 0.012, "I3": 0.013, open_one: 0.5}
    velocity = (3.0, 0.001) if open_one == "I4" else (0.0, 0.9)
    of_gap = gap((1.0, p["I3"]), velocity, se=0.05)
    found = by_rule(who_first((1.0, p["I1"]), (-1.0, p["I2"])), of_gap)
    assert list(found) == ["I1", "I2", "I3", "I4"]
    assert [name for name, verdict in found.items() if not verdict.passed] == [open_one]


@pytest.mark.parametrize(("p", "passed"), [(0.049, False), (0.05, True)])
@pytest.mark.parametrize("b", [-1.0, 1.0])
def test_i4_holds_by_the_paper_where_the_effect_is_not_significant(b, p, passed):
    assert paper_verdicts(who_first(), gap(velocity=(b, p)))["I4"] == Judgement(passed)


@pytest.mark.parametrize(
    ("terms", "robust"),
    [
        # The product is significant for the humans of the paper, and they have the mark.
        ({"velocity": (-0.2, 0.236), "product": (0.06, 0.031), "se": 0.03}, True),
        ({"velocity": (-0.2, 0.236), "product": (0.2, 0.031), "se": 0.03}, False),
        ({"velocity": (0.1, 0.9), "se": 1.0}, False),  # a large p alone shows no equivalence
    ],
)
def test_i4_looks_at_the_main_effect_alone_by_the_paper_and_at_all_terms_robustly(terms, robust):
    fit = gap(**terms)
    assert paper_verdicts(who_first(), fit)["I4"].passed is True
    assert robust_verdicts(who_first(), fit)["I4"].passed is robust


@pytest.mark.parametrize("sign", [-1, 1])
@pytest.mark.parametrize("se", [0.02, 0.05])
def test_i4_holds_robustly_where_the_effect_is_shown_to_be_small(sign, se):
    edge = 1.25 - stats.t.isf(0.05, 106) * se  # of a slope that is multiplied by 0.8 m/s
    found = [
        robust_verdicts(who_first(), gap(velocity=(sign * (edge + off), 0.5), se=se))["I4"].passed
        for off in (-0.01, 0.01)
    ]
    assert found == [True, False]


def trials_of(gaps_m) -> pd.DataFrame:
    columns = ["projected_headway_m", "relative_velocity_mps", "status", "gap_m"]
    rows = [
        (CONDITIONS[name].projected_headway_m, CONDITIONS[name].relative_velocity_mps,
         "finished", gap_m)
        for name, gap_m in gaps_m.items()
    ]  # fmt: skip
    return pd.DataFrame(rows, columns=columns)


def by_product(slope):
    """Gaps that grow with the product of projected headway and relative velocity."""
    return {
        name: 5 + slope * c.projected_headway_m * c.relative_velocity_mps
        for name, c in CONDITIONS.items()
    }


@pytest.mark.filterwarnings("error", "ignore::ResourceWarning")
@pytest.mark.parametrize(("slope", "passed"), [(0.15, True), (0.16, False)])
def test_gaps_without_spread_are_compared_with_the_margin_themselves(slope, passed):
    """They lie on the regression: a slope of 1 / 6.4 of the product is 1 m."""
    fit = gap_ols(trials_of(by_product(slope)), robust=True)
    assert robust_verdicts(who_first(), fit)["I4"] == Judgement(passed)
    assert [equivalence_p(b, 0.0, 9) for b in (0.0, 0.999, -0.999, 1.0, -1.0)] == [0, 0, 0, 1, 1]


def test_differences_are_of_played_conditions_with_one_projected_headway():
    """Without the pairs of 1.6 m/s at 4 m only differences of 0.8 m/s are left, which are small."""
    rng = np.random.default_rng(5)
    gaps_m = by_product(0.3)
    some = {name: m for name, m in gaps_m.items() if name not in {"L_4_8", "R_-4_-8"}}
    for played, holds in ((gaps_m, False), (some, True)):
        trials = pd.concat([trials_of(played)] * 20)
        trials["gap_m"] += rng.normal(0, 0.01, len(trials))
        fit = gap_ols(trials, robust=True)
        assert robust_verdicts(who_first(), fit)["I4"] == Judgement(holds)


def test_without_conditions_that_differ_in_relative_velocity_alone_i4_is_not_judged():
    fit = replace(gap(), equivalence_p=None)
    assert robust_verdicts(who_first(), fit)["I4"] == Judgement(None, Fact(Why.NONE_APART))
    assert paper_verdicts(who_first(), fit)["I4"].passed is True


@pytest.mark.parametrize("b", [-2.0, -1.0, -0.3, 0.0, 0.8, 1.0])
@pytest.mark.parametrize("freedom", [3, 106])
def test_equivalence_is_the_larger_p_of_two_one_sided_t_tests(b, freedom):
    not_below = stats.t.sf((b + GAP_MARGIN_M) / 0.4, freedom)  # against at most -1 m
    not_above = stats.t.cdf((b - GAP_MARGIN_M) / 0.4, freedom)  # against at least 1 m
    assert equivalence_p(b, 0.4, freedom) == pytest.approx(max(not_below, not_above))


def test_a_separated_fit_is_neither_a_pass_nor_a_failure_and_no_part_of_the_score():
    found = paper_verdicts(SEPARATED, gap((0.2, 0.2)))
    assert found["I1"] == found["I2"] == Judgement(None, SEPARATED.problem)
    assert total(found) == "1 of 2"
    assert total({"I1": Judgement(None, "too few")}) is None


@BOTH
def test_a_fit_that_is_missing_leaves_its_indicators_open(by_rule):
    nobody = Regression(0, {}, Fact(Why.NO_FIRST))
    first, second = Judgement(None, nobody.problem), Judgement(None, MISSING.problem)
    yes = Judgement(True)
    assert [*by_rule(nobody, gap(se=0.05)).values()] == [first, first, yes, yes]
    assert [*by_rule(who_first(), MISSING).values()] == [yes, yes, second, second]
