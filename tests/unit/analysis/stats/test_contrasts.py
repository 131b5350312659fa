"""Differences between groups, against the independent recomputation and other libraries."""

from math import sqrt

import numpy as np
import pandas as pd
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import optimize, stats
from statsmodels.stats.contingency_tables import StratifiedTable
from statsmodels.stats.multitest import multipletests

from analysis.research.independent.recompute_statistics import means_within as recomputed_means
from merge_runner_analysis import two_drivers
from merge_runner_analysis.stats.contrasts import (
    Cells,
    contrast_means,
    contrast_rates,
    corrected,
    detectable_rate,
    difference_of_contrasts,
    means_within,
    rejected,
    shared_cells,
)
from merge_runner_analysis.stats.score_interval import Z
from merge_runner_analysis.stats.verdicts import holm_levels
from tests.support.harness import PROJECT


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


def test_the_example_of_two_models_has_the_numbers_of_its_test():
    n = np.full(11, 10)
    found = contrast_rates(Cells(np.array([2] + [1] * 10), n, np.full(11, 3), n))
    values = {
        "k": 12,
        "n": 110,
        "k_reference": 33,
        "n_reference": 110,
        "difference": 100 * found.value,
        "ci": (100 * found.low, 100 * found.high),
        "p_corrected": corrected([found.p, *[1.0] * 6])[0],
    }
    claim, _ = two_drivers.apart("o3", "gpt-6-sol", {"collided_percent": values}, of_left=False)
    assert claim in " ".join((PROJECT / "docs/run-a-study.md").read_text().split())


def difference_at(cells, apart):
    """The observed difference less another one, in standard errors if that one is true."""
    return (cells.difference - apart) / sqrt(cells.variance(apart))


@pytest.mark.parametrize("strata", STRATA)
def test_shares_are_compared_by_the_test_of_mantel_and_haenszel_and_its_score_interval(strata):
    cells = shared_cells(*trials(strata), "hit")
    found = contrast_rates(cells)
    weights = [n * m / (n + m) for _, n, _, m in strata.values()]
    apart = [a / n - b / m for a, n, b, m in strata.values()]
    assert found.value == pytest.approx(np.average(apart, weights=weights))
    tables = [np.array([[a, n - a], [b, m - b]]) for a, n, b, m in strata.values()]
    expected = StratifiedTable(tables).test_null_odds(correction=False).pvalue
    assert found.p == pytest.approx(expected)
    for end in (found.low, found.high):
        assert abs(end) == 1 or abs(difference_at(cells, end)) == pytest.approx(Z)


SIZES = st.integers(1, 12)


@st.composite
def cells_of(draw):
    """The counts of up to five cells."""
    sizes = draw(st.lists(st.tuples(SIZES, SIZES), min_size=1, max_size=5))
    counts = [(draw(st.integers(0, n)), n, draw(st.integers(0, m)), m) for n, m in sizes]
    return Cells(*map(np.array, zip(*counts, strict=True)))


@given(cells_of())
def test_two_rates_differ_by_their_difference(cells):
    one, other = cells.rates
    assert one - other == pytest.approx(cells.difference)


@given(cells_of(), cells_of())
def test_an_interval_of_shares_leaves_0_out_exactly_where_p_is_below_5_percent(one, other):
    for found in (contrast_rates(one), difference_of_contrasts(one, other)):
        assert found.low <= found.value <= found.high
        assert found.low < found.high
        assert (found.p < 0.05) == (found.low > 0 or found.high < 0)


GAPS = st.dictionaries(
    st.sampled_from("abcd"), st.lists(st.floats(-20, 20), min_size=1, max_size=6), min_size=1
)


@given(GAPS, GAPS)
def test_an_interval_of_means_leaves_0_out_exactly_where_p_is_below_5_percent(one, other):
    found = contrast_means(group(**one), group(**other), "gap_m")
    if found is not None and found.se:
        assert (found.p < 0.05) == (found.low > 0 or found.high < 0)


@pytest.mark.parametrize(
    ("a", "b", "low", "high"),
    # As R's ratesci::scoreci and SAS PROC FREQ have it, who call it Miettinen and Nurminen's.
    [(0, 0, -0.0720, 0.0720), (50, 50, -0.0720, 0.0720), (1, 0, -0.0528, 0.1056)],
)
def test_none_or_all_of_the_trials_have_an_interval_too(a, b, low, high):
    found = contrast_rates(Cells(*(np.array([each]) for each in (a, 50, b, 50))))
    assert (found.low, found.high) == pytest.approx((low, high), abs=1e-4)
    assert found.detectable == pytest.approx(0.137, abs=1e-3)


def test_the_likeliest_rates_of_a_difference_are_those_of_a_search():
    a, n, b, m = 3, 10, 9, 15
    for apart in (-0.6, -0.2, 0.0, 0.3):

        def missing(q, apart=apart):
            p = np.clip(q + apart, 1e-12, 1 - 1e-12)
            return -stats.binom.logpmf(a, n, p) - stats.binom.logpmf(b, m, q)

        found = optimize.minimize_scalar(
            missing, bounds=(max(0, -apart) + 1e-9, min(1, 1 - apart) - 1e-9), method="bounded",
            options={"xatol": 1e-10},
        )  # fmt: skip
        q, p = found.x, found.x + apart
        expected = (p * (1 - p) / n + q * (1 - q) / m) * 25 / 24
        cells = Cells(*(np.array([each]) for each in (a, n, b, m)))
        assert cells.variance(apart) == pytest.approx(expected, abs=1e-6)


def test_the_detectable_difference_of_shares_is_found_in_four_of_five_studies():
    rng, size = np.random.default_rng(2), np.full(11, 10)
    none = contrast_rates(Cells(0 * size + 3, size, 0 * size + 3, size))
    found = [
        contrast_rates(
            Cells(rng.binomial(size, 0.3 + none.detectable), size, rng.binomial(size, 0.3), size)
        )
        for _ in range(300)
    ]
    assert np.mean([one.p < 0.05 for one in found]) == pytest.approx(0.8, abs=0.07)
    assert contrast_rates(Cells(*(np.array([k]) for k in (0, 2, 0, 2)))).detectable is None


def test_a_condition_that_one_group_lacks_changes_nothing_of_its_rates():
    first, second = trials(STRATA[0])
    more = pd.concat([first, pd.DataFrame({"condition": ["c"] * 50, "hit": [True] * 50})])
    expected = contrast_rates(shared_cells(first, second, "hit"))
    assert contrast_rates(shared_cells(more, second, "hit")) == expected
    apart = (one[one["condition"] == name] for one, name in ((first, "a"), (second, "b")))
    assert shared_cells(*apart, "hit") is None


def test_a_trial_that_stands_in_one_cell_alone_varies_also_if_it_was_read_from_both_sides():
    """Trial 1 has no partner on its other side, so that its two outcomes do not add up to 1."""
    read = pd.DataFrame(
        {"condition": ["L", "R", "L", "R"], "value": [1.0, 0.0, 1.0, 0.0], "row": [0, 0, 1, 1]}
    )
    both = pd.DataFrame({"condition": ["L", "R"], "value": [0.0, 1.0]})
    assert shared_cells(both, read, "value").varying[1].tolist() == [0, 0]
    alone = shared_cells(both[:1], read, "value")
    assert alone.varying[1].tolist() == [1]
    assert alone.variance(0) == shared_cells(
        both[:1], read[::2].drop(columns="row"), "value"
    ).variance(0)


def test_an_interaction_of_shares_is_excluded_at_the_level_of_its_p():
    one, other = (shared_cells(*trials(strata), "hit") for strata in STRATA[:2])
    found = difference_of_contrasts(one, other)
    assert found.value == pytest.approx(one.difference - other.difference)
    z = stats.norm.isf(found.p / 2)
    near = (one.end(-1, z) - one.difference, other.end(1, z) - other.difference)
    assert abs(found.value) == pytest.approx(np.hypot(*near), abs=1e-6)
    assert difference_of_contrasts(one, one).p == 1
    all_of, none = np.array([1_000_000]), np.array([0])
    sure = Cells(all_of, all_of, none, all_of)
    assert difference_of_contrasts(sure, Cells(none, all_of, all_of, all_of)).p < 1e-190
    same = Cells(all_of, all_of, all_of, all_of)
    nothing = difference_of_contrasts(same, same)
    assert (nothing.se, nothing.p) == (0, 1)
    assert nothing.low < 0 < nothing.high


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
    expected = by_cells(recomputed_means, one, other, "gap_m")
    assert (found.value, found.low, found.high, found.p, found.detectable) == pytest.approx(
        tuple(expected[k] for k in ("difference", "ci_low", "ci_high", "p", "detectable"))
    )
    first, second = means_within(one, other, "gap_m")
    assert first - second == pytest.approx(found.value)
    # Trials without the measure do not count.
    missing = group(N_0_0=[np.nan, np.nan], L_4_8=[np.nan])
    assert contrast_means(pd.concat([one, missing]), pd.concat([missing, other]), "gap_m") == found
    if one is SPREAD[0]:
        welch = stats.ttest_ind(one["gap_m"], other["gap_m"], equal_var=False)
        assert (found.p, found.freedom) == pytest.approx((welch.pvalue, welch.df))


def test_where_nothing_varies_a_difference_is_sure_or_there_is_nothing_to_test():
    found = contrast_means(group(N_0_0=[3.0] * 4), group(N_0_0=[2.0] * 4), "gap_m")
    assert (found.value, found.low, found.high, found.p) == (1, 1, 1, 0)
    found = contrast_means(group(N_0_0=[3.0] * 4), group(N_0_0=[3.0] * 4), "gap_m")
    assert (found.value, found.bounds(), found.p) == (0, None, None)


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
