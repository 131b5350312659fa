"""Intervals of proportions and means, against other implementations and by their properties."""

from __future__ import annotations

from math import hypot, inf

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats
from statsmodels.stats.proportion import proportion_confint

from merge_runner_analysis.stats.intervals import (
    Estimate,
    detectable,
    difference,
    estimate,
    mean,
    proportion,
)

NOTHING = Estimate(None, None, None, 0)
SHARES = st.integers(1, 5000).flatmap(lambda n: st.tuples(st.integers(0, n), st.just(n)))
VALUES = st.lists(st.floats(-1e6, 1e6), min_size=2, max_size=30)


@pytest.mark.parametrize("n", [1, 2, 7, 110, 962, 990])
def test_a_proportion_has_the_wilson_interval(n):
    successes = np.arange(n + 1)
    found = [proportion(int(count), n) for count in successes]
    intervals = proportion_confint(successes, n, alpha=0.05, method="wilson")
    for bounds, expected in zip(("low", "high"), intervals, strict=True):
        assert [getattr(f, bounds) for f in found] == pytest.approx(list(expected), abs=1e-12)
    assert [(f.value, f.n) for f in found] == [(count / n, n) for count in successes]


def test_28_of_990_lie_between_1_96_and_4_06_percent():
    found = proportion(28, 990)
    assert found.value == pytest.approx(0.0283, abs=5e-5)
    assert (found.low, found.high) == pytest.approx((0.0196, 0.0406), abs=5e-5)


@pytest.mark.parametrize("n", [1, 3, 22, 110, 990])
def test_none_and_all_bound_the_interval_exactly(n):
    assert proportion(0, n).low == 0
    assert proportion(n, n).high == 1
    assert 0 < proportion(0, n).high < 1
    assert 0 < proportion(n, n).low < 1


def test_no_trial_has_no_proportion():
    assert proportion(0, 0) == NOTHING


@given(SHARES)
def test_a_proportion_lies_inside_its_interval_and_that_between_0_and_1(share):
    found = proportion(*share)
    assert 0 <= found.low <= found.value <= found.high <= 1
    assert found.low < found.high


@given(SHARES)
def test_failures_have_the_mirrored_interval_of_successes(share):
    successes, n = share
    found, mirrored = proportion(successes, n), proportion(n - successes, n)
    assert (1 - mirrored.high, 1 - mirrored.low) == pytest.approx((found.low, found.high))


def test_a_mean_has_the_interval_of_students_t():
    values = np.random.default_rng(3).normal(3.85, 1.8, 17)
    found = mean(values)
    interval = stats.t.interval(0.95, 16, loc=values.mean(), scale=stats.sem(values))
    assert (found.low, found.high) == pytest.approx(interval)
    assert (found.value, found.n) == (pytest.approx(values.mean()), 17)


def test_the_mean_of_1_2_and_3_lies_between_minus_0_48_and_4_48():
    """2 +- 4.3027 / sqrt(3), with the tabulated quantile of t at 2 degrees of freedom."""
    found = mean([1, 2, 3])
    assert (found.low, found.value, found.high) == pytest.approx((-0.4841, 2, 4.4841), abs=5e-5)


@pytest.mark.parametrize("gap", [np.nan, np.inf, -np.inf])
def test_values_that_are_not_finite_do_not_count(gap):
    assert mean([1.0, gap, 2.0, 3.0]) == mean([1.0, 2.0, 3.0])


def test_one_value_has_no_interval_and_none_has_no_mean():
    assert mean([4.2]) == Estimate(4.2, None, None, 1)
    assert mean([np.nan, 4.2]) == Estimate(4.2, None, None, 1)
    assert mean([]) == NOTHING
    assert mean([np.nan]) == NOTHING


@given(VALUES)
def test_a_mean_lies_inside_its_interval_and_between_the_extremes(values):
    found = mean(values)
    assert found.low <= found.value <= found.high
    assert min(values) - 1e-6 <= found.value <= max(values) + 1e-6


SAMPLES = st.lists(st.integers(-50, 50).map(float), min_size=2, max_size=20).map(np.array)


@pytest.mark.filterwarnings("ignore:Precision loss occurred")
@given(SAMPLES, SAMPLES)
def test_a_difference_of_means_is_welchs_t_test(one, other):
    found = difference(mean(one), mean(other))
    if not one.std() + other.std():
        assert found is None
        return
    welch = stats.ttest_ind(one, other, equal_var=False)
    assert (found.p, found.freedom) == (pytest.approx(welch.pvalue), pytest.approx(welch.df))
    interval = welch.confidence_interval(0.95)
    assert found.bounds() == pytest.approx((interval.low, interval.high))
    assert found.bounds(100) == pytest.approx((100 * interval.low, 100 * interval.high))


def test_a_difference_of_likelihood_estimates_is_a_normal_test():
    found = difference(estimate(0.7, 0.3, inf, 9), estimate(0.0, 0.4, inf, 9))
    assert found.freedom == inf
    assert found.p == pytest.approx(2 * stats.norm.sf(0.7 / hypot(0.3, 0.4)))
    assert found.bounds() == pytest.approx(stats.norm.interval(0.95, 0.7, 0.5))
    assert found.detectable == detectable(0.5) == pytest.approx(0.5 * (1.959964 + 0.841621))


def test_what_has_no_interval_has_no_bounds():
    assert NOTHING.bounds() is None
    assert Estimate(4.2, None, None, 1).bounds(100) is None
