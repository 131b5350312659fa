"""How often intervals hold the truth and tests find nothing, in simulated studies."""

import numpy as np
import pytest
from scipy import stats

from analysis.research.ceiling import shares
from merge_runner_analysis.published import published
from merge_runner_analysis.stats.first_action import exchange_rate, mean, slope
from merge_runner_analysis.stats.intervals import melded
from tests.support.first_actions import HEADWAY, SLOPE, VELOCITY, drawn


@pytest.mark.parametrize("rates", [(0.02, 0.03), (0.3, 0.03), (0.5, 0.5), (0.0, 0.03)])
def test_a_melded_interval_holds_the_true_difference_in_95_percent(rates):
    """Over all outcomes of 9 trials beside 20."""
    n, m, covered = 9, 20, 0.0
    for a in range(n + 1):
        for b in range(m + 1):
            chance = stats.binom.pmf(a, n, rates[0]) * stats.binom.pmf(b, m, rates[1])
            if chance > 1e-6:
                p = stats.fisher_exact([[a, n - a], [b, m - b]]).pvalue
                low, high = melded((a / n, n), (b / m, m), p)
                covered += chance * (low <= rates[0] - rates[1] <= high)
    assert covered > 0.949


@pytest.mark.parametrize(
    ("estimate", "truth"), [(slope, SLOPE), (mean, 0.0), (exchange_rate, -VELOCITY / HEADWAY)]
)
def test_intervals_of_first_actions_cover_the_truth_as_often_as_they_say(estimate, truth):
    rng = np.random.default_rng(4)
    found = [estimate(drawn(rng)) for _ in range(200)]  # few have separated words, and no rate
    inside = np.mean([one.low < truth < one.high for one in found if one])
    assert 0.9 <= inside <= 0.99  # three standard errors of such a share


@pytest.mark.parametrize("n", [2, 10, 50])
def test_the_script_of_the_ceiling_computes_what_ships(n):
    curve = published("human_ceiling").set_index(["n", "indicator", "rule"])["share"]
    found = shares(n, first=60)
    assert len(found) == 10
    for key, share in found.items():
        low, high = stats.binom.interval(0.999, 60, curve[n, *key])
        assert low <= round(60 * share) <= high
