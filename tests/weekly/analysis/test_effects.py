"""Coverage and false positives of the tests of effects, over simulated studies."""

from math import sqrt

import numpy as np
import pandas as pd
import pytest
from scipy.special import expit

from merge_runner_analysis.stats.contrasts import (
    Cells,
    contrast_means,
    contrast_rates,
    difference_of_contrasts,
)

STUDIES = 2000
ERROR = 3 * sqrt(0.05 * 0.95 / STUDIES)
# Who goes first in eleven conditions, most of which decide it; and rates of collisions.
FIRST = np.linspace(-4, 4, 11)
WORLDS = {
    "who goes first, no effect": (expit(FIRST), expit(FIRST)),
    "who goes first, 1.5 logits": (expit(FIRST + 1.5), expit(FIRST)),
    "few collisions": (np.full(11, 0.03), np.full(11, 0.03)),
    "none and some collisions": (np.full(11, 0.1), np.full(11, 0.0)),
    "many collisions": (np.full(11, 0.25), np.full(11, 0.05)),
}


def drawn(rng, one, other, trials):
    """The counts of a study in which some trials do not count."""
    n, m = (rng.binomial(trials, 0.93, 11) for _ in range(2))
    kept = (n > 0) & (m > 0)
    counts = Cells(rng.binomial(n, one)[kept], n[kept], rng.binomial(m, other)[kept], m[kept])
    return counts, float(counts.shares @ (one - other)[kept])


@pytest.mark.parametrize("trials", [5, 10, 20])
@pytest.mark.parametrize("world", WORLDS)
def test_intervals_of_shares_hold_the_truth_and_nothing_is_found_where_nothing_is(world, trials):
    """Few trials of a cell and rare collisions make them wider than they need to be."""
    rng, (one, other) = np.random.default_rng(7), WORLDS[world]
    covered, found = 0, 0
    for _ in range(STUDIES):
        cells, truth = drawn(rng, one, other, trials)
        estimate = contrast_rates(cells)
        covered += estimate.low <= truth <= estimate.high
        found += estimate.p < 0.05
    assert 0.95 - ERROR <= covered / STUDIES <= 0.995
    if (one == other).all():
        assert found / STUDIES <= 0.05 + ERROR


@pytest.mark.parametrize("shift", [0.0, 1.5])
def test_interactions_of_shares_are_found_no_more_often_than_they_should(shift):
    rng, (one, other) = np.random.default_rng(8), (expit(FIRST + shift), expit(FIRST))
    found = 0
    for _ in range(STUDIES // 4):
        first, _ = drawn(rng, one, other, 10)
        second, _ = drawn(rng, one, other, 10)
        found += difference_of_contrasts(first, second).p < 0.05
    assert found / (STUDIES // 4) <= 0.05 + 2 * ERROR


def test_means_hold_their_level_also_where_groups_differ_in_size_and_spread():
    rng, covered = np.random.default_rng(9), 0
    for _ in range(STUDIES):
        frames = []
        for size, spread in ((4, 3.0), (10, 1.0)):
            cells = np.repeat(np.arange(11), size)
            kept = rng.random(len(cells)) < 0.9
            gap_m = cells + spread * rng.standard_normal(len(cells))
            frames.append(pd.DataFrame({"condition": cells, "gap_m": gap_m})[kept])
        estimate = contrast_means(*frames, "gap_m")
        covered += estimate.low <= 0 <= estimate.high
    assert covered / STUDIES == pytest.approx(0.95, abs=ERROR)


@pytest.mark.parametrize("biased", [0.0, 1.0])
def test_trials_that_are_read_from_both_sides_leave_the_level_of_the_test_as_it_is(biased):
    """Nobody goes first for a hurry; the left one does more often, in every condition."""
    rng, found = np.random.default_rng(10), 0
    left = expit(FIRST + biased)
    for _ in range(STUDIES):
        untreated = rng.binomial(10, left)
        on_left, on_right = rng.binomial(5, left), 5 - rng.binomial(5, left)
        cells = Cells(
            np.concatenate([on_left, on_right]),
            np.full(22, 5),
            np.concatenate([untreated, 10 - untreated]),
            np.full(22, 10),
            (1.0, 0.0),
        )
        found += contrast_rates(cells).p < 0.05
    assert 0.03 <= found / STUDIES <= 0.05 + ERROR
