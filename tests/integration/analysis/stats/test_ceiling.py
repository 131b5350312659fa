"""The human ceiling is a shipped curve that its script computes."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest
from scipy import stats

from benchmarks.ceiling import DATA_SETS, SIZES, data_sets, shares
from merge_runner.scenarios.merge.conditions import CONDITIONS
from merge_runner_analysis.data.reference_data import published
from merge_runner_analysis.stats.indicators import ceiling

CELLS = [(c.projected_headway_m, c.relative_velocity_mps) for c in CONDITIONS.values()]
NAMES = ["I1", "I2", "I3", "I4", "I1-I4"]


def even(n):
    return (n,) * len(CONDITIONS)


@pytest.mark.slow
@pytest.mark.parametrize("n", [2, 10, 50])
def test_the_script_computes_what_ships(n):
    curve = published("human_ceiling").set_index(["n", "indicator", "rule"])["share"]
    found = shares(n, first=60)
    assert len(found) == 10
    for key, share in found.items():
        low, high = stats.binom.interval(0.999, 60, curve[n, *key])
        assert low <= round(60 * share) <= high


def test_the_file_has_each_size_indicator_and_rule_once():
    curve = published("human_ceiling")
    assert list(curve["n"].unique()) == list(SIZES)
    assert not curve.duplicated(["n", "indicator", "rule"]).any()
    assert len(curve) == len(SIZES) * 2 * len(NAMES)
    assert curve["share"].between(0, 1).all()


def test_a_data_set_has_so_many_published_outcomes_of_each_condition():
    trials = next(data_sets(5))
    assert list(trials["condition"].value_counts()) == [5] * 11
    every = pd.concat(set_ for _, set_ in zip(range(DATA_SETS), data_sets(2), strict=True))
    assert (every["status"] == "collided").mean() == pytest.approx(28 / 990, abs=0.005)
    of_finished = every[every["status"] == "finished"]
    assert (of_finished["merged_first"] == "left").mean() == pytest.approx(465 / 962, abs=0.02)


def test_a_ceiling_is_that_of_the_curve_and_between_its_sizes_linear():
    found = ceiling(even(10))
    assert found["paper"] == {"I1": 0.81, "I2": 0.81, "I3": 0.388, "I4": 0.93, "I1-I4": 0.296}
    assert found["robust"] == {"I1": 1.0, "I2": 1.0, "I3": 0.381, "I4": 0.032, "I1-I4": 0.015}
    between = ceiling(even(13))["paper"]["I3"]
    assert between == pytest.approx(
        ceiling(even(12))["paper"]["I3"] * 2 / 3 + ceiling(even(15))["paper"]["I3"] / 3
    )
    assert ceiling(even(500)) == ceiling(even(200))


def test_the_mean_size_decides_and_every_condition_needs_a_trial():
    uneven = ceiling((9, 11, *even(10)[2:]))
    assert uneven == ceiling(even(10))
    assert ceiling((0, *even(10)[1:])) == {"paper": {}, "robust": {}}


def test_the_ceiling_rises_with_the_number_of_trials():
    found = [ceiling(even(n)) for n in (5, 10, 50)]
    for each in ([c["paper"]["I1-I4"] for c in found], [c["robust"]["I1-I4"] for c in found]):
        assert each == sorted(each)
        assert each[0] < 0.15
        assert each[-1] > 0.5


@pytest.mark.parametrize("n", [5, 10, 20])
def test_the_power_of_the_gap_tests_is_that_of_noncentral_t(n):
    """As if 962 of 990 trials had finished in every condition alike."""
    h, dv = np.array(CELLS).T
    x = np.column_stack([np.ones(11), abs(h), abs(dv), h * dv])
    per_condition = n * 962 / 990
    errors = 1.82 * np.sqrt(np.diag(np.linalg.inv(x.T @ x)) / per_condition)
    freedom = 11 * per_condition - 4
    critical = stats.t.isf(0.025, freedom)
    grows = stats.nct.sf(critical, freedom, 0.17 / errors[1])
    shift = -0.2 / errors[2]
    within = stats.nct.cdf(critical, freedom, shift) - stats.nct.cdf(-critical, freedom, shift)
    found = ceiling(even(n))
    assert found["paper"]["I3"] == pytest.approx(grows, abs=0.05)
    assert found["paper"]["I4"] == pytest.approx(within, abs=0.04)
    # Two one-sided tests at 1 m of each pair that differs in relative velocity alone.
    apart = np.array(
        [x[i] - x[j] for i in range(11) for j in range(11) if h[i] == h[j] and dv[i] > dv[j]]
    )
    covariance = 1.82**2 * np.linalg.inv(x.T @ x) / per_condition
    drawn_b = np.random.default_rng(1).multivariate_normal(
        [3.54, 0.17, -0.2, 0.06], covariance, 4000
    )
    half = stats.t.isf(0.05, freedom) * np.sqrt(np.einsum("cj,jk,ck->c", apart, covariance, apart))
    inside = (np.abs(drawn_b @ apart.T) + half < 1).all(axis=1).mean()
    assert found["robust"]["I4"] == pytest.approx(inside, abs=0.06)


def test_i1_to_i4_together_pass_no_oftener_than_each():
    found = ceiling(even(10))["paper"]
    each = [found[name] for name in NAMES[:4]]
    assert sum(each) - 3 <= found["I1-I4"] <= min(each)
