"""Differences between groups, against the independent recomputation and other libraries."""

from math import sqrt

import numpy as np
import pandas as pd
import pytest
from scipy import stats
from statsmodels.stats.multitest import multipletests

from analysis.research.independent.recompute_statistics import exact_p, means_within
from merge_runner_analysis.stats import intervals
from merge_runner_analysis.stats.contrasts import (
    contrast_cells,
    contrast_means,
    corrected,
    detectable_rate,
    difference_of_rates,
    rejected,
    shared_cells,
)
from merge_runner_analysis.stats.verdicts import holm_levels


def trials(strata) -> tuple[pd.DataFrame, pd.DataFrame]:
    """One row a trial of either group; ``strata`` are (successes, n) of both, by condition."""
    groups = ([], [])
    for name, (a, n, b, m) in strata.items():
        for group, k, size in zip(groups, (a, b), (n, m), strict=True):
            group += [(name, i < k) for i in range(size)]
    return tuple(pd.DataFrame(group, columns=["condition", "hit"]) for group in groups)


def by_cells(recomputed, one, other, column):
    return recomputed(one[column], other[column], (one["condition"], other["condition"]))


STRATA = [
    {"a": (3, 10, 1, 20), "b": (9, 10, 12, 15)},
    {"a": (0, 5, 0, 5), "b": (2, 5, 0, 5), "c": (1, 4, 3, 9)},
    {"a": (4, 4, 0, 6), "b": (0, 3, 3, 3)},
    {"a": (16, 110, 28, 110)},
    {"a": (5, 5, 0, 4)},
]


@pytest.mark.parametrize("strata", STRATA)
def test_rates_are_compared_by_fishers_test_within_conditions_and_the_interval_that_agrees(strata):
    one, other = trials(strata)
    found = contrast_cells(shared_cells(one, other, "hit"))
    weights = [n * m / (n + m) for _, n, _, m in strata.values()]
    apart = [a / n - b / m for a, n, b, m in strata.values()]
    assert found.value == pytest.approx(np.average(apart, weights=weights))
    assert found.p == pytest.approx(by_cells(exact_p, one, other, "hit"))
    assert found.low <= found.value <= found.high
    assert (found.p < 0.05) == (not found.low <= 0 <= found.high)


def test_a_condition_that_one_group_lacks_changes_nothing_of_its_rates():
    first, second = trials(STRATA[0])
    more = pd.concat([first, pd.DataFrame({"condition": ["c"] * 50, "hit": [True] * 50})])
    expected = contrast_cells(shared_cells(first, second, "hit"))
    assert contrast_cells(shared_cells(more, second, "hit")) == expected
    apart = (one[one["condition"] == name] for one, name in ((first, "a"), (second, "b")))
    assert shared_cells(*apart, "hit") is None


def test_an_interaction_of_rates_is_excluded_at_the_level_of_its_p():
    one, other = (shared_cells(*trials(strata), "hit") for strata in STRATA[:2])
    rates = [*one.rates, *reversed(other.rates)]
    found = difference_of_rates(rates)
    p, q, r, s = (rate for rate, _ in rates)
    assert found.value == pytest.approx(p - q + r - s)
    ends = [np.array(intervals.wilson(*rate)) for rate in rates]
    below = [ends[0][0] - p, ends[1][1] - q, ends[2][0] - r, ends[3][1] - s]
    assert found.value - found.low == pytest.approx(sqrt(sum(d**2 for d in below)))
    low, high = intervals.newcombe(rates, stats.norm.isf(found.p / 2))
    assert min(abs(low), abs(high)) == pytest.approx(0, abs=1e-9)
    assert difference_of_rates([*one.rates, *reversed(one.rates)]).p == 1
    assert 0 < difference_of_rates([(1.0, 1_000_000), (0.0, 1_000_000)]).p < 1e-190


def test_which_outcomes_fishers_test_rejects_is_known_beforehand():
    n, m = 20, 9
    p = [[stats.fisher_exact([[a, n - a], [b, m - b]]).pvalue for b in range(m + 1)]
         for a in range(n + 1)]  # fmt: skip
    assert rejected(n, m).tolist() == (np.array(p) < 0.05).tolist()


@pytest.mark.parametrize(
    ("n", "m", "rate", "sign"), [(110, 110, 0.0, 1), (60, 60, 0.95, -1), (40, 50, 0.4, -1)]
)
def test_the_detectable_difference_of_rates_is_found_in_four_of_five_studies(n, m, rate, sign):
    other = rate + sign * detectable_rate(n, m, rate)
    one, two = (stats.binom.pmf(np.arange(k + 1), k, p) for k, p in ((n, other), (m, rate)))
    assert one @ rejected(n, m) @ two == pytest.approx(0.8, abs=0.01)
    assert detectable_rate(2, 2, 0.0) is None


def group(**values) -> pd.DataFrame:
    """Trials by condition: one row a value."""
    rows = [(name, value) for name, column in values.items() for value in column]
    return pd.DataFrame(rows, columns=["condition", "gap_m"])


FIRST = group(N_0_0=[1.0, 4.5, 5.0], L_4_8=[9.0, 12.0])
SECOND = group(N_0_0=[2.0, 3.0], L_4_8=[6.0, 7.5, 7.0, 9.5])
RNG = np.random.default_rng(4)
# Of unequal size and spread, where a pooled variance is wrong; and of unequal mixes of conditions.
SPREAD = group(N_0_0=RNG.normal(0, 5, 8)), group(N_0_0=RNG.normal(1, 1, 40))
MIXED = (
    group(N_0_0=RNG.normal(2, 1, 40), L_4_8=RNG.normal(8, 1, 10)),
    group(N_0_0=RNG.normal(2, 1, 10), L_4_8=RNG.normal(8, 1, 40)),
)


@pytest.mark.parametrize(("one", "other"), [(FIRST, SECOND), SPREAD, MIXED])
def test_means_are_compared_by_welchs_test_with_a_level_for_each_condition(one, other):
    found = contrast_means(one, other, "gap_m")
    expected = by_cells(means_within, one, other, "gap_m")
    assert (found.value, found.low, found.high, found.p, found.detectable) == pytest.approx(
        tuple(expected[k] for k in ("difference", "ci_low", "ci_high", "p", "detectable"))
    )
    # Trials without the measure do not count.
    missing = group(N_0_0=[np.nan, np.nan], L_4_8=[np.nan])
    assert contrast_means(pd.concat([one, missing]), pd.concat([missing, other]), "gap_m") == found
    if one is SPREAD[0]:
        welch = stats.ttest_ind(one["gap_m"], other["gap_m"], equal_var=False)
        assert (found.p, found.freedom) == pytest.approx((welch.pvalue, welch.df))


@pytest.mark.parametrize(("other", "p"), [(3.0, 1), (2.0, 0)])
def test_where_nothing_varies_a_difference_is_none_or_sure(other, p):
    found = contrast_means(group(N_0_0=[3.0] * 4), group(N_0_0=[other] * 4), "gap_m")
    assert (found.value, found.low, found.high, found.p) == (3 - other, 3 - other, 3 - other, p)


def test_two_trials_and_groups_that_share_no_condition_cannot_be_compared():
    assert contrast_means(group(N_0_0=[3.0]), group(N_0_0=[4.0]), "gap_m") is None
    assert contrast_means(group(N_0_0=[1.0, 2.0]), group(L_4_8=[1.0, 2.0]), "gap_m") is None


@pytest.mark.parametrize("n", [1, 2, 7, 40])
def test_a_family_is_corrected_as_by_statsmodels(n):
    family = list(np.random.default_rng(n).random(n).round(1) ** 3)  # with ties
    assert corrected(family) == pytest.approx(list(multipletests(family, method="holm")[1]))
    assert corrected([]) == []


def test_the_levels_of_intervals_are_those_of_holms_steps():
    p = {"a": 0.001, "b": 0.04, "c": 0.02, "d": 0.9}
    # Of four the smallest is below .05 / 4; the next is not below .05 / 3, and ends it.
    found = holm_levels(p, dict(zip(p, corrected([*p.values()]), strict=True)))
    assert [*found.values()] == pytest.approx([1 - 0.05 / 4, *[1 - 0.05 / 3] * 3])
