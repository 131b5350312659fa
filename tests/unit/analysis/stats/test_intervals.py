"""Intervals of proportions and means, against other implementations and by their properties."""

from itertools import product
from math import hypot, inf

import numpy as np
import pytest
from scipy import stats
from statsmodels.stats.proportion import proportion_confint

from merge_runner_analysis.stats.estimate import Estimate
from merge_runner_analysis.stats.intervals import (
    at,
    detectable,
    difference,
    estimate,
    mean,
    melded,
    proportion,
)
from merge_runner_analysis.stats.measures import median

NOTHING = Estimate(None, None, None, 0)


def test_an_interval_with_one_end_is_none():
    assert Estimate(1.0, 0.5, None, 3).bounds() is None
    assert Estimate(1.0, None, 1.5, 3).bounds() is None
    assert Estimate(1.0, 0.5, 1.5, 3).bounds() == (0.5, 1.5)


@pytest.mark.parametrize("n", [1, 2, 7, 110, 990])
def test_a_proportion_has_the_wilson_interval_whose_ends_are_exact(n):
    successes = np.arange(n + 1)
    found = [proportion(int(count), n) for count in successes]
    intervals = proportion_confint(successes, n, alpha=0.05, method="wilson")
    for bounds, expected in zip(("low", "high"), intervals, strict=True):
        assert [getattr(f, bounds) for f in found] == pytest.approx(list(expected), abs=1e-12)
    assert [(f.value, f.n) for f in found] == [(count / n, n) for count in successes]
    assert (found[0].low, found[-1].high) == (0, 1)
    assert all(0 <= f.low <= f.value <= f.high <= 1 and f.low < f.high for f in found)


def test_no_trial_has_no_proportion_and_no_value_no_bounds():
    assert proportion(0, 0) == mean([]) == mean([np.nan]) == NOTHING
    assert NOTHING.bounds() is Estimate(4.2, None, None, 1).bounds() is None
    assert mean([4.2]) == mean([np.nan, 4.2]) == Estimate(4.2, None, None, 1)


def test_a_mean_has_the_interval_of_students_t():
    """Of 1, 2, 3 it is 2 +- 4.3027 / sqrt(3), with the tabulated quantile."""
    found = mean([1, 2, 3])
    assert (found.low, found.value, found.high) == pytest.approx((-0.4841, 2, 4.4841), abs=5e-5)
    values = np.random.default_rng(3).normal(3.85, 1.8, 17)
    found = mean([*values, np.nan, np.inf, -np.inf])  # what is not finite does not count
    interval = stats.t.interval(0.95, 16, loc=values.mean(), scale=stats.sem(values))
    assert (*found.bounds(), found.value) == pytest.approx((*interval, values.mean()))
    assert found.n == 17


@pytest.mark.parametrize("seed", range(4))
def test_a_difference_of_means_is_welchs_t_test(seed):
    rng = np.random.default_rng(seed)
    one, other = (rng.normal(0, 1 + 3 * seed * k, 2 + 7 * seed * k) for k in (0, 1))
    found, welch = difference(mean(one), mean(other)), stats.ttest_ind(one, other, equal_var=False)
    assert (found.p, found.freedom) == (pytest.approx(welch.pvalue), pytest.approx(welch.df))
    interval = welch.confidence_interval(0.95)
    assert found.in_percent().bounds() == pytest.approx((100 * interval.low, 100 * interval.high))
    assert difference(mean([1.0, 1.0]), mean([2.0, 2.0])) is None


def test_a_share_in_percent_has_its_ends_in_percent_at_every_level():
    share = Estimate(0.5, ends_at=lambda level: None if level == 1 else (0.5 - level, 0.75))
    assert at(share.in_percent(), 0.25).bounds() == (25, 75)
    assert at(share.in_percent(), 1).bounds() is None


def test_a_difference_of_likelihood_estimates_is_a_normal_test():
    found = difference(estimate(0.7, 0.3, inf, 9), estimate(0.0, 0.4, inf, 9))
    assert found.freedom == inf
    assert found.p == pytest.approx(2 * stats.norm.sf(0.7 / hypot(0.3, 0.4)))
    assert found.bounds() == pytest.approx(stats.norm.interval(0.95, 0.7, 0.5))
    assert found.detectable == detectable(0.5) == pytest.approx(0.5 * (1.959964 + 0.841621))


@pytest.mark.parametrize("n", [6, 7, 20, 101])
def test_the_interval_of_a_median_covers_it_in_95_of_100_samples_and_is_no_wider(n):
    found = median(np.arange(1.0, n + 1)[::-1])
    k = int(found.low)
    assert (found.value, found.high) == ((n + 1) / 2, n + 1 - k)
    assert 1 - 2 * stats.binom.cdf(k - 1, n, 0.5) >= 0.95 > 1 - 2 * stats.binom.cdf(k, n, 0.5)


def test_few_values_have_a_median_without_an_interval():
    assert (median(np.arange(5.0)).value, median(np.arange(5.0)).low) == (2, None)
    assert median(np.array([])).value is None


def test_a_melded_interval_agrees_with_fishers_test_at_every_level():
    for (a, n), (b, m) in product([(0, 9), (2, 9), (7, 110), (9, 9)], [(28, 990), (0, 40), (5, 5)]):
        p = stats.fisher_exact([[a, n - a], [b, m - b]]).pvalue
        for level in (0.9, 0.95, 0.99, 1 - 1.01 * p, 1 - 0.99 * p):
            if not 0.5 < level < 1:
                continue
            low, high = melded((a / n, n), (b / m, m), p, level)
            assert -1 <= low <= a / n - b / m + 1e-9, (a, n, b, m, level)
            assert a / n - b / m - 1e-9 <= high <= 1, (a, n, b, m, level)
            assert (low <= 1e-9 and high >= -1e-9) == (p >= 1 - level), (a, n, b, m, level)
