"""The human ceiling is a shipped curve with the power that theory gives."""

import pytest

from merge_runner.scenarios.merge.conditions import CONDITIONS
from merge_runner_analysis.stats.indicators import ceiling


def even(n):
    return (n,) * len(CONDITIONS)


def test_a_ceiling_is_that_of_the_curve_and_between_its_sizes_linear():
    found = ceiling(even(10))
    assert found["paper"] == {"I1": 0.81, "I2": 0.81, "I3": 0.388, "I4": 0.93, "I1-I4": 0.296}
    assert found["robust"] == {"I1": 1.0, "I2": 1.0, "I3": 0.381, "I4": 0.032, "I1-I4": 0.015}
    below, between, above = (ceiling(even(n))["paper"]["I3"] for n in (12, 13, 15))
    assert between == pytest.approx(below * 2 / 3 + above / 3)
    assert ceiling(even(500)) == ceiling(even(200))


def test_the_mean_size_decides_and_every_condition_needs_a_trial():
    assert ceiling((9, 11, *even(10)[2:])) == ceiling(even(10))
    assert ceiling((0, *even(10)[1:])) == {"paper": {}, "robust": {}}
