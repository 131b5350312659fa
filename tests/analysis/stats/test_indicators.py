"""The verdicts on hand-made regressions."""

from __future__ import annotations

from functools import partial
from math import inf

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from analysis.stats.group_scores import total
from analysis.stats.indicators import (
    GAP_MARGIN_M,
    INDICATORS,
    LARGEST_VELOCITY_MPS,
    PAPER,
    ROBUST,
    SLOPE_MARGIN_S,
    Verdict,
    equivalence_p,
    judged,
    verdicts,
)
from analysis.stats.regressions import Regression, Term
from merge_runner.scenarios.merge.conditions import CONDITIONS

SEPARATED = "separation: no finite estimate of projected_headway; see Firth's fit"
MISSING = Regression(0, {}, "no finished trial with a gap")
paper_verdicts, robust_verdicts = partial(verdicts, PAPER), partial(verdicts, ROBUST)
BOTH = pytest.mark.parametrize("by_rule", [paper_verdicts, robust_verdicts])


def who_first(headway=(1.0, 0.001), velocity=(-3.0, 0.001)) -> Regression:
    """A fit of who merges first; (b, p) of its slopes."""
    terms = {"intercept": (0.0, 0.5), "projected_headway": headway, "relative_velocity": velocity}
    return Regression(110, {name: Term(b, 0.1, None, p) for name, (b, p) in terms.items()})


def gap(headway=(0.2, 0.001), velocity=(0.0, 0.9), product=(0.0, 0.9), se=0.2) -> Regression:
    """A fit of the gap; (b, p) of its slopes."""
    terms = {
        "intercept": (4.0, 0.001),
        "abs_projected_headway": headway,
        "abs_relative_velocity": velocity,
        "headway_x_velocity": product,
    }
    fitted = {name: Term(b, se, b / se, p) for name, (b, p) in terms.items()}
    return Regression(110, fitted, freedom=106)


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
    found = by_rule(who_first((1.0, p["I1"]), (-1.0, p["I2"])), gap((1.0, p["I3"]), velocity))
    assert list(found) == ["I1", "I2", "I3", "I4"]
    assert [name for name, verdict in found.items() if not verdict.passed] == [open_one]


@pytest.mark.parametrize(
    ("p", "passed"), [(0.001, False), (0.049, False), (0.05, True), (0.9, True)]
)
def test_i4_holds_by_the_paper_where_the_effect_is_not_significant(p, passed):
    for b in (-1.0, 1.0):
        assert paper_verdicts(who_first(), gap(velocity=(b, p)))["I4"] == Verdict(passed)


def test_i4_looks_at_the_main_effect_alone():
    """The product is significant for the humans of the paper, and they have the mark."""
    humans = gap(velocity=(-0.2, 0.236), product=(0.06, 0.031), se=0.166)
    plain = gap(velocity=(-0.2, 0.236), product=(0.0, 0.9), se=0.166)
    assert paper_verdicts(who_first(), humans)["I4"].passed is True
    assert robust_verdicts(who_first(), humans)["I4"].passed is True
    assert robust_verdicts(who_first(), humans)["I4"] == robust_verdicts(who_first(), plain)["I4"]


def test_the_margin_of_i4_is_1_m_for_the_largest_velocity_of_the_experiment():
    largest = max(abs(condition.relative_velocity_mps) for condition in CONDITIONS.values())
    assert (1.0, largest) == (GAP_MARGIN_M, LARGEST_VELOCITY_MPS)
    assert pytest.approx(1.25) == SLOPE_MARGIN_S


@pytest.mark.parametrize("b", [-2.0, -1.25, -1.0, -0.3, 0.0, 0.3, 1.0, 1.25, 2.0])
@pytest.mark.parametrize("freedom", [3, 106])
def test_equivalence_is_the_larger_p_of_two_one_sided_t_tests(b, freedom):
    se = 0.4
    not_below = stats.t.sf((b + 1.25) / se, freedom)  # against a slope of at most -1.25
    not_above = stats.t.cdf((b - 1.25) / se, freedom)  # against a slope of at least 1.25
    assert equivalence_p(b, se, freedom) == pytest.approx(max(not_below, not_above))


COEFFICIENTS = st.lists(
    st.tuples(
        st.floats(-3, 3),
        st.floats(0.01, 2),
        st.floats(0, 1),
        st.one_of(st.integers(1, 500).map(float), st.just(inf)),
    ),
    min_size=1,
)


@given(COEFFICIENTS)
@pytest.mark.parametrize("criteria", [PAPER, ROBUST])
def test_many_fits_are_judged_like_each_of_them(criteria, rows):
    together = [np.array(column) for column in zip(*rows, strict=True)]
    for criterion in criteria.values():
        holds = criterion.holds(*together)
        for i, (b, se, alone_p, freedom) in enumerate(rows):
            fit = Regression(9, {criterion.term: Term(b, se, None, alone_p)}, freedom=freedom)
            assert judged(criterion, fit) == Verdict(bool(holds[i]))


def test_equivalence_at_the_margin_is_a_coin_toss():
    assert equivalence_p(1.25, 0.3, 50) == equivalence_p(-1.25, 0.3, 50) == 0.5


@pytest.mark.parametrize("sign", [-1, 1])
def test_i4_holds_robustly_where_the_effect_is_shown_to_be_small(sign):
    quantile = stats.t.isf(0.05, 106)
    for se in (0.1, 0.5):
        edge = 1.25 - quantile * se
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


def test_a_score_counts_only_what_can_be_judged_and_names_the_rest():
    found = total(paper_verdicts(Regression(110, {}, SEPARATED), gap((0.2, 0.2))))
    assert (str(found), found.open) == ("1 of 2", ("I1", "I2"))
    assert str(total({"I1": Verdict(None, "too few")})) == "0 of 0"


@BOTH
def test_a_fit_that_is_missing_leaves_its_indicators_open(by_rule):
    nobody = Regression(0, {}, "no finished trial with a first merger")
    found = by_rule(nobody, gap())
    assert found["I1"] == found["I2"] == Verdict(None, nobody.problem)
    assert (found["I3"].passed, found["I4"].passed) == (True, True)
    found = by_rule(who_first(), MISSING)
    assert found["I3"] == found["I4"] == Verdict(None, MISSING.problem)
    assert (found["I1"].passed, found["I2"].passed) == (True, True)


def test_every_indicator_is_described():
    assert list(INDICATORS) == ["I1", "I2", "I3", "I4", "I5"]
