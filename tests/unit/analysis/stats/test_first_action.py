"""First actions: planted slopes and exchange rates are found, with intervals that hold."""

import numpy as np
import pandas as pd
import pytest
from scipy import stats

from merge_runner_analysis.stats.first_action import (
    exchange_rate,
    fieller,
    human_exchange_rate,
    mean,
    slope,
)
from tests.support.first_actions import HEADWAY, VELOCITY, drawn


def test_the_published_human_rate_is_that_of_the_published_coefficients():
    rate = human_exchange_rate()
    assert rate.value == pytest.approx(3.304 / 1.111, abs=2e-3)
    assert rate.low < 2.97 < rate.high
    assert 0.3 < rate.high - rate.low < 1.2


def test_a_rate_over_a_slope_that_may_be_0_has_no_finite_interval():
    rng = np.random.default_rng(3)
    rows = drawn(rng, 44)
    weak = rows.assign(tactical=np.where(rng.random(len(rows)) < 0.5, "M", "Y"))
    found = exchange_rate(weak)
    assert found.value is not None
    assert found.bounds() is None


def test_fiellers_interval_ends_where_the_test_of_a_ratio_does():
    covariance = np.array([[0.04, 0.02], [0.02, 0.25]])
    low, high = fieller(1.1, -3.3, covariance, 20)
    assert low < 3 < high
    for rate in (low, high):
        se = np.sqrt(np.array([rate, 1.0]) @ covariance @ np.array([rate, 1.0]))
        assert abs(-3.3 + rate * 1.1) / se == pytest.approx(stats.t.ppf(0.975, 20))
    assert fieller(0.3, -3.3, covariance, 20) is None


def test_the_errors_are_those_of_a_cluster_sandwich_with_students_t():
    rows = drawn(np.random.default_rng(6), 30)
    design = np.column_stack([np.ones(60), rows["velocity_mps"]])
    bread = np.linalg.inv(design.T @ design)
    residuals = rows["first_mps2"] - design @ (bread @ design.T @ rows["first_mps2"])
    sums = pd.DataFrame(design * residuals.to_numpy()[:, None]).groupby(rows["cluster"]).sum()
    scale = 30 / 29 * 59 / 58
    expected = np.sqrt((bread @ (sums.T @ sums).to_numpy() @ bread * scale)[1, 1])
    found = slope(rows)
    assert found.se == pytest.approx(expected)
    assert (found.high - found.value) / found.se == pytest.approx(2.04523, abs=1e-4)


@pytest.mark.parametrize(
    ("changes", "estimate"),
    [
        ({"velocity_mps": 0.8}, slope),
        ({"cluster": 0}, slope),
        ({"cluster": 0}, mean),
        ({"tactical": "M"}, exchange_rate),
        ({"tactical": None}, exchange_rate),
        ({"headway_m": 0.0}, exchange_rate),
    ],
)
def test_where_the_rows_tell_nothing_there_is_no_estimate(changes, estimate):
    assert estimate(drawn(np.random.default_rng(7), 22).assign(**changes)) is None


def test_separated_words_have_no_rate():
    rows = drawn(np.random.default_rng(8))
    odds = HEADWAY * rows["headway_m"] + VELOCITY * rows["velocity_mps"]
    assert exchange_rate(rows.assign(tactical=np.where(odds > 0, "M", "Y"))) is None
