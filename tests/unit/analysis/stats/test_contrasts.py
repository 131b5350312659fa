"""Differences between groups, against enumerations and figures worked out by hand."""

from __future__ import annotations

from math import comb, sqrt

import numpy as np
import pandas as pd
import pytest
from scipy import stats
from statsmodels.regression.linear_model import OLS
from statsmodels.stats.multitest import multipletests

from merge_runner_analysis.stats import intervals
from merge_runner_analysis.stats.contrasts import (
    Cells,
    contrast_cells,
    contrast_means,
    corrected,
    detectable_rate,
    difference_of_rates,
    rejected,
    shared_cells,
)


def contrast_rates(first, second):
    """Two rates of one condition, (successes, n) each."""
    return contrast_cells(Cells(*np.array([[*first, *second]]).T))


def fisher(first, second) -> float:
    """Fisher's two-sided p: all tables with these margins that are no likelier."""
    (a, n), (b, m) = first, second
    total = a + b
    ways = {k: comb(n, k) * comb(m, total - k) for k in range(max(0, total - m), min(n, total) + 1)}
    return sum(w for w in ways.values() if w <= ways[a]) / sum(ways.values())


def wilson(successes, n):
    """Wilson's bounds of a proportion."""
    z = 1.959964
    centre, width = successes + z**2 / 2, z * sqrt(successes * (n - successes) / n + z**2 / 4)
    return (centre - width) / (n + z**2), (centre + width) / (n + z**2)


def newcombe(first, second):
    """Newcombe's (1998) hybrid score interval, his method 10."""
    p, q = first[0] / first[1], second[0] / second[1]
    (p_low, p_high), (q_low, q_high) = wilson(*first), wilson(*second)
    low = p - q - sqrt((p - p_low) ** 2 + (q_high - q) ** 2)
    high = p - q + sqrt((p_high - p) ** 2 + (q - q_low) ** 2)
    return low, high


RATES = [
    ((0, 110), (28, 990)),
    ((28, 110), (28, 990)),
    ((16, 110), (28, 110)),
    ((3, 110), (0, 110)),
    ((5, 5), (0, 4)),
]


@pytest.mark.parametrize(("first", "second"), RATES)
def test_rates_are_compared_by_fishers_test_and_the_interval_that_agrees(first, second):
    found = contrast_rates(first, second)
    assert found.value == pytest.approx(first[0] / first[1] - second[0] / second[1])
    assert found.p == pytest.approx(fisher(first, second), rel=1e-6)
    assert found.low <= found.value <= found.high
    assert (found.p < 0.05) == (not found.low <= 0 <= found.high)
    low, high = newcombe(first, second)  # of the same width, but for what is exact
    assert found.high - found.low == pytest.approx(high - low, rel=0.35)


# By condition: successes and trials of one group, and of the other.
STRATA = [
    {"a": (3, 10, 1, 20), "b": (9, 10, 12, 15)},
    {"a": (0, 5, 0, 5), "b": (2, 5, 0, 5), "c": (1, 4, 3, 9)},
    {"a": (4, 4, 0, 6), "b": (0, 3, 3, 3)},
]


def trials(strata) -> tuple[pd.DataFrame, pd.DataFrame]:
    """One row a trial, of either group."""
    groups = ([], [])
    for name, (a, n, b, m) in strata.items():
        for group, k, size in zip(groups, (a, b), (n, m), strict=True):
            group += [(name, i < k) for i in range(size)]
    return tuple(pd.DataFrame(group, columns=["condition", "hit"]) for group in groups)


def standardised(strata) -> tuple[tuple[float, float], tuple[float, float]]:
    """Both rates by the weights of Mantel and Haenszel, with the trials that they are as good as.

    Those are the trials with which an unweighted rate had the variance, of equal rates; and as many
    more as the variance within conditions is less than that of all outcomes. Each condition has one
    trial more, of the overall rate.
    """
    rates, spreads, total = [0.0, 0.0], [0.0, 0.0], 0.0
    of_both, inside = 0.0, 0.0
    for a, n, b, m in strata.values():
        weight = n * m / (n + m)
        total += weight
        of_both += weight * (a + b) / (n + m)
        for i, (k, size) in enumerate(((a, n), (b, m))):
            rates[i] += weight * k / size
            spreads[i] += weight**2 / size
    overall = of_both / total
    for a, n, b, m in strata.values():
        rate = (a + b + overall) / (n + m + 1)
        inside += n * m / (n + m) / total * rate * (1 - rate)
    more = max(1.0, overall * (1 - overall) / inside)
    return tuple((rates[i] / total, more * total**2 / spreads[i]) for i in (0, 1))


@pytest.mark.parametrize("strata", STRATA)
def test_rates_are_compared_within_conditions(strata):
    found = contrast_cells(shared_cells(*trials(strata), "hit"))
    (p, n), (q, m) = standardised(strata)
    assert found.value == pytest.approx(p - q)
    assert (found.low, found.high) == pytest.approx(intervals.melded((p, n), (q, m), found.p))
    assert (found.p < 0.05) == (not found.low <= 0 <= found.high)
    # How likely each sum of the first group is, where each condition has as many successes.
    chances: dict[int, float] = {0: 1.0}
    for a, n, b, m in strata.values():
        ways = {k: comb(n, k) * comb(m, a + b - k) for k in range(n + 1) if 0 <= a + b - k <= m}
        chances = {
            total: sum(chances.get(total - k, 0) * w / sum(ways.values()) for k, w in ways.items())
            for total in range(max(chances) + n + 1)
        }
    seen = chances[sum(a for a, *_ in strata.values())]
    expected = sum(chance for chance in chances.values() if chance <= seen * (1 + 1e-9))
    assert found.p == pytest.approx(expected)


def test_a_condition_that_one_group_lacks_changes_nothing_of_its_rates():
    first, second = trials(STRATA[0])
    more = pd.concat([first, pd.DataFrame({"condition": ["c"] * 50, "hit": [True] * 50})])
    expected = contrast_cells(shared_cells(first, second, "hit"))
    assert contrast_cells(shared_cells(more, second, "hit")) == expected
    assert (
        shared_cells(first[first["condition"] == "a"], second[second["condition"] == "b"], "hit")
        is None
    )


def test_rates_that_differ_by_their_conditions_alone_do_not_differ():
    """Simpson's paradox: each condition is the same for both, but not how often it was driven."""
    first, second = trials({"easy": (1, 10, 10, 100), "hard": (90, 100, 9, 10)})
    found = contrast_cells(shared_cells(first, second, "hit"))
    assert (found.value, found.p) == (pytest.approx(0), pytest.approx(1))
    assert abs(first["hit"].mean() - second["hit"].mean()) > 0.6


def test_an_interaction_of_rates_is_excluded_at_the_level_of_its_p():
    one, other = (shared_cells(*trials(strata), "hit") for strata in STRATA[:2])
    found = difference_of_rates([*one.rates, *reversed(other.rates)])
    rates = (*standardised(STRATA[0]), *reversed(standardised(STRATA[1])))
    (p, n), (q, m), (r, k), (s, j) = rates
    assert found.value == pytest.approx(p - q - (s - r))
    bounds = [wilson(rate * size, size) for rate, size in ((p, n), (q, m), (r, k), (s, j))]
    (pl, pu), (ql, qu), (rl, ru), (sl, su) = bounds
    low = sqrt((p - pl) ** 2 + (qu - q) ** 2 + (r - rl) ** 2 + (su - s) ** 2)
    high = sqrt((pu - p) ** 2 + (q - ql) ** 2 + (ru - r) ** 2 + (s - sl) ** 2)
    assert (found.low, found.high) == pytest.approx((found.value - low, found.value + high))
    z = stats.norm.isf(found.p / 2)
    low, high = intervals.newcombe(rates, z)
    assert min(abs(low), abs(high)) == pytest.approx(0, abs=1e-9)
    assert difference_of_rates([*one.rates, *reversed(one.rates)]).p == 1


def test_an_interaction_of_means_is_the_difference_of_both_differences_with_welchs_test():
    one, other = contrast_means(FIRST, SECOND, "gap_m"), contrast_means(SECOND, FIRST, "gap_m")
    found = intervals.difference(one, other)
    assert found.value == pytest.approx(2 * one.value)
    assert found.se == pytest.approx(sqrt(2) * one.se)
    assert found.freedom == pytest.approx(2 * one.freedom)


def test_in_one_condition_means_are_compared_by_welchs_test():
    """Groups of unequal size and spread, where a pooled variance is wrong."""
    rng = np.random.default_rng(4)
    first, second = rng.normal(0, 5, 8), rng.normal(1, 1, 40)
    found = contrast_means(group(N_0_0=first), group(N_0_0=second), "gap_m")
    welch = stats.ttest_ind(first, second, equal_var=False)
    assert (found.p, found.freedom) == pytest.approx((welch.pvalue, welch.df))
    assert (found.low, found.high) == pytest.approx(tuple(welch.confidence_interval()))


def test_a_small_group_that_scatters_differs_by_chance_in_one_of_twenty():
    rng, found = np.random.default_rng(5), 0
    for _ in range(400):
        first = group(N_0_0=rng.normal(2, 4, 3), L_4_8=rng.normal(8, 4, 3))
        second = group(N_0_0=rng.normal(2, 1, 30), L_4_8=rng.normal(8, 1, 30))
        found += contrast_means(first, second, "gap_m").p < 0.05
    assert 0.02 * 400 < found < 0.08 * 400


def test_o3s_collisions_do_not_differ_from_the_humans_and_geminis_do():
    assert contrast_rates((0, 110), (28, 990)).p == pytest.approx(0.10, abs=0.005)
    assert contrast_rates((28, 110), (28, 990)).p == pytest.approx(3e-15, rel=0.2)
    assert contrast_rates((3, 110), (0, 110)).p == pytest.approx(0.25, abs=0.005)


def test_which_outcomes_fishers_test_rejects_is_known_beforehand():
    for n, m in ((7, 12), (20, 9)):
        expected = [[fisher((a, n), (b, m)) < 0.05 for b in range(m + 1)] for a in range(n + 1)]
        assert rejected(n, m).tolist() == expected


def power(n, m, rate, other, studies=2000) -> float:
    """Share of simulated studies in which Fisher's test finds the difference."""
    rng = np.random.default_rng(1)
    drawn = zip(rng.binomial(n, other, studies), rng.binomial(m, rate, studies), strict=True)
    pairs, times = np.unique(list(drawn), axis=0, return_counts=True)
    found = [stats.fisher_exact([[a, n - a], [b, m - b]]).pvalue < 0.05 for a, b in pairs.tolist()]
    return float(times @ found) / studies


@pytest.mark.parametrize(
    ("n", "m", "rate", "sign"),
    [(110, 990, 28 / 990, 1), (110, 110, 0.0, 1), (60, 60, 0.95, -1), (40, 50, 0.4, -1)],
)
def test_the_detectable_difference_of_rates_is_found_in_four_of_five_studies(n, m, rate, sign):
    found = detectable_rate(n, m, rate)
    assert power(n, m, rate, rate + sign * found) == pytest.approx(0.8, abs=0.03)


def test_110_trials_without_a_collision_could_show_no_less_than_7_percent():
    assert contrast_rates((3, 110), (0, 110)).detectable == pytest.approx(0.071, abs=0.001)


def test_so_few_trials_show_no_difference_however_large():
    assert contrast_rates((2, 2), (0, 2)).detectable is None


def group(**values) -> pd.DataFrame:
    """Trials by condition: one row a value."""
    rows = [(name, value) for name, column in values.items() for value in column]
    return pd.DataFrame(rows, columns=["condition", "gap_m"])


FIRST = group(N_0_0=[1.0, 4.5, 5.0], L_4_8=[9.0, 12.0])
SECOND = group(N_0_0=[2.0, 3.0], L_4_8=[6.0, 7.5, 7.0, 9.5])


NAMES = ("N_0_0", "L_4_8")


def within_conditions(first, second) -> float:
    """The difference of means within conditions, weighted by n m / (n + m)."""
    total = weights = 0.0
    for name in NAMES:
        x, y = (g.loc[g["condition"] == name, "gap_m"] for g in (first, second))
        weight = len(x) * len(y) / (len(x) + len(y))
        total, weights = total + weight * (x.mean() - y.mean()), weights + weight
    return total / weights


def test_interval_and_test_are_welchs_in_a_model_with_a_level_for_each_condition():
    found = contrast_means(FIRST, SECOND, "gap_m")
    both = pd.concat([FIRST, SECOND])
    of_first = np.repeat([True, False], [len(FIRST), len(SECOND)])
    x = np.column_stack([of_first, *(both["condition"] == name for name in NAMES)]).astype(float)
    y = both["gap_m"].to_numpy()
    fit = OLS(y, x).fit(cov_type="HC2")
    assert found.value == pytest.approx(fit.params[0]) == within_conditions(FIRST, SECOND)
    assert found.se == pytest.approx(fit.bse[0])
    # Satterthwaite's degrees of freedom of that quadratic form of residuals, by whole matrices.
    left = np.eye(len(y)) - x @ np.linalg.pinv(x)
    squared = (left @ y) ** 2 / np.diag(left)
    variances = np.where(of_first, squared[of_first].mean(), squared[~of_first].mean())
    form = np.diag(np.linalg.pinv(x)[0] ** 2 / np.diag(left)) @ left @ np.diag(variances) @ left
    assert found.freedom == pytest.approx(np.trace(form) ** 2 / np.trace(form @ form))
    t = stats.t(found.freedom)
    half = t.ppf(0.975) * found.se
    assert (found.low, found.high) == pytest.approx((found.value - half, found.value + half))
    assert found.detectable == pytest.approx((t.ppf(0.975) + t.ppf(0.8)) * found.se)
    assert found.p == pytest.approx(2 * t.sf(abs(found.value) / found.se))


def mixes(shift, seed=2):
    """Equal drivers but for ``shift`` in one condition; each has lost many trials of another."""
    rng = np.random.default_rng(seed)
    first = group(N_0_0=rng.normal(2, 1, 40), L_4_8=rng.normal(8, 1, 10))
    second = group(N_0_0=rng.normal(2 + shift, 1, 10), L_4_8=rng.normal(8 + shift, 1, 40))
    return first, second


def test_another_mix_of_conditions_alone_is_no_difference():
    found = contrast_means(*mixes(0), "gap_m")
    assert found.low < 0 < found.high
    assert found.p > 0.2


@pytest.mark.parametrize("shift", [-1.0, 1.0])
def test_a_difference_is_found_in_either_direction_whatever_the_mix(shift):
    found = contrast_means(*mixes(shift), "gap_m")
    assert found.p < 0.005
    assert found.low < -shift < found.high


def test_groups_that_share_no_condition_cannot_be_compared():
    assert contrast_means(group(N_0_0=[1.0, 2.0]), group(L_4_8=[1.0, 2.0]), "gap_m") is None


def test_a_difference_within_conditions_is_found():
    rng = np.random.default_rng(2)
    first = group(N_0_0=rng.normal(2, 1, 20), L_4_8=rng.normal(8, 1, 20))
    second = first.assign(gap_m=first["gap_m"] + 1.5)
    assert contrast_means(first, second, "gap_m").p < 0.001


def test_trials_without_the_measure_do_not_count():
    missing = group(N_0_0=[np.nan, np.nan], L_4_8=[np.nan])
    found = contrast_means(pd.concat([FIRST, missing]), pd.concat([missing, SECOND]), "gap_m")
    assert found == contrast_means(FIRST, SECOND, "gap_m")


def test_where_nothing_varies_there_is_no_difference():
    equal = group(N_0_0=[3.0] * 4)
    found = contrast_means(equal, equal, "gap_m")
    assert (found.value, found.low, found.high, found.p) == (0, 0, 0, 1)


def test_where_nothing_varies_within_conditions_a_difference_is_sure():
    found = contrast_means(group(N_0_0=[3.0] * 4), group(N_0_0=[2.0] * 4), "gap_m")
    assert (found.value, found.low, found.high, found.p) == (1, 1, 1, 0)


def test_two_trials_alone_have_no_test():
    assert contrast_means(group(N_0_0=[3.0]), group(N_0_0=[4.0]), "gap_m") is None


def test_a_family_is_corrected_by_holm():
    assert corrected([0.01, 0.04, 0.03, 0.005]) == pytest.approx([0.03, 0.06, 0.06, 0.02])
    assert corrected([0.6, 0.9, 0.2]) == pytest.approx([1.0, 1.0, 0.6])
    assert corrected([]) == []


@pytest.mark.parametrize("n", [1, 2, 7, 40])
def test_the_correction_is_that_of_statsmodels(n):
    family = list(np.random.default_rng(n).random(n).round(1) ** 3)  # with ties
    assert corrected(family) == pytest.approx(list(multipletests(family, method="holm")[1]))
