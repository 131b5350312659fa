"""The exchange rate of headway and relative velocity: planted ones are found."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.special import expit

from analysis.stats.exchange import fieller, of_actions, of_humans, of_words

H, V = 1.11, -3.30
GRID = np.array([(h, v) for h in np.arange(-6, 7, 2.0) for v in np.arange(-1.6, 1.7, 0.4)])
POINTS = np.tile(GRID, (4, 1))
# Three standard errors of a share of 0.95 among 150 studies.
LOW, HIGH = 0.895, 1.0
ALONE = np.arange(len(POINTS), dtype=float)


def said(rng, points=POINTS):
    return (rng.random(len(points)) < expit(0.2 + points @ [H, V])).astype(float)


def test_the_published_human_rate_is_that_of_the_published_coefficients():
    found = of_humans()
    assert found.n == 962
    assert (found.headway.value, found.velocity.value) == pytest.approx((1.111, -3.304), abs=1e-3)
    assert found.rate == pytest.approx(3.304 / 1.111, abs=2e-3)
    assert found.bounds[0] < 2.97 < found.bounds[1]
    assert 0.3 < found.bounds[1] - found.bounds[0] < 1.2


@pytest.mark.slow
def test_intervals_of_words_cover_the_planted_rate_as_often_as_they_say():
    rng = np.random.default_rng(1)
    fits = [of_words(POINTS, said(rng), ALONE) for _ in range(150)]
    inside = [fit.bounds[0] < -V / H < fit.bounds[1] for fit in fits]
    assert LOW <= np.mean(inside) <= HIGH
    slopes = [fit.velocity.low < V < fit.velocity.high for fit in fits]
    assert LOW <= np.mean(slopes) <= HIGH


@pytest.mark.slow
def test_two_answers_of_a_trial_that_depend_on_each_other_are_not_counted_as_two():
    """The other side says the opposite at the mirrored point: nothing new is learnt from it."""
    rng = np.random.default_rng(2)
    points = np.vstack([POINTS, -POINTS])
    trials = np.tile(ALONE, 2)
    covered = []
    for _ in range(150):
        left = (rng.random(len(POINTS)) < expit(POINTS @ [H, V])).astype(float)
        fit = of_words(points, np.concatenate([left, 1 - left]), trials)
        covered.append(fit.velocity.low < V < fit.velocity.high)
    assert LOW <= np.mean(covered) <= HIGH
    alone = of_words(points, np.concatenate([left, 1 - left]), np.arange(len(points), dtype=float))
    widths = [one.velocity.high - one.velocity.low for one in (fit, alone)]
    assert widths[0] > 1.3 * widths[1]


def test_intervals_of_actions_cover_the_planted_rate_as_often_as_they_say():
    rng = np.random.default_rng(3)
    covered = []
    for _ in range(150):
        action = POINTS @ [0.1, -0.338] + rng.normal(0, 0.6, len(POINTS))
        fit = of_actions(POINTS, action, ALONE)
        covered.append(fit.bounds is not None and fit.bounds[0] < 3.38 < fit.bounds[1])
    assert LOW <= np.mean(covered) <= HIGH


def test_without_an_effect_of_headway_the_interval_has_no_end_and_says_so():
    rng = np.random.default_rng(4)
    action = POINTS @ [0.0, -0.3] + rng.normal(0, 0.6, len(POINTS))
    found = of_actions(POINTS, action, ALONE)
    assert found.bounds is None
    assert "has no end, since the slope on headway may be 0" in found.unbounded
    nothing = of_actions(POINTS, rng.normal(0, 0.6, len(POINTS)), ALONE)
    assert nothing.bounds is None
    assert "no value is excluded" in nothing.unbounded


def test_fieller_is_the_delta_method_where_headway_is_sure():
    bounds, words = fieller(np.array([1.0, -3.0]), np.diag([1e-8, 0.01]), 1.96)
    assert words == ""
    assert bounds == pytest.approx((3 - 0.196, 3 + 0.196), abs=1e-3)


def test_the_line_of_even_odds_goes_through_them():
    found = of_words(POINTS, said(np.random.default_rng(5)), ALONE)
    for velocity in (-1.0, 0.0, 1.5):
        h = found.indifferent_m(velocity)
        odds = found.intercept + found.headway.value * h + found.velocity.value * velocity
        assert odds == pytest.approx(0, abs=1e-9)


def test_separated_words_have_a_penalised_fit_and_say_so():
    merging = (POINTS @ [H, V] > 0).astype(float)
    found = of_words(POINTS, merging, ALONE)
    assert "Firth's penalised fit" in found.remark
    assert found.headway.value > 0 > found.velocity.value


@pytest.mark.parametrize(
    ("points", "merging", "said"),
    [
        (POINTS, np.ones(len(POINTS)), f"M in all {len(POINTS)} answers"),
        (POINTS, np.zeros(len(POINTS)), f"Y in all {len(POINTS)} answers"),
        (np.zeros((50, 2)), np.arange(50) % 2.0, "too few or at too few points"),
        (np.zeros((0, 2)), np.zeros(0), "0 answers, too few"),
    ],
)
def test_what_tells_no_slopes_says_why(points, merging, said):
    found = of_words(points, merging, np.arange(len(points), dtype=float))
    assert (found.headway, found.rate) == (None, None)
    assert found.remark.startswith(said) or said in found.remark


def test_equal_actions_tell_no_slopes():
    assert of_actions(POINTS, np.zeros(len(POINTS)), ALONE).remark.endswith("all equal")
