"""First actions: planted truths are found, and a copy of the humans is not called different."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from analysis.data.first_actions import Acts, published_classes
from analysis.data.reference_data import published
from analysis.stats.first_look import (
    CUE,
    GRID,
    LATE,
    LEVEL,
    PUBLISHED,
    SIDE,
    cue,
    distances,
    ecdf,
    faults,
    humans_from,
    published_humans,
    skill,
)
from merge_runner.scenarios.merge.conditions import HUMAN_CONDITIONS

STUDIES = 200
SITUATIONS = 400
# The correlation of two humans' first actions in a trial is about 0.3.
TOGETHER = 0.3
VELOCITIES = np.array([one.relative_velocity_mps for one in HUMAN_CONDITIONS.values()])
CLASSES = published_classes()


def drawn(rng, trials, *, looks=True) -> Acts:
    """Trials of both drivers by the published distributions, held for the first second.

    Without ``looks`` each acts as if the other were as fast.
    """
    velocity = np.resize(VELOCITIES, trials)
    uniform = stats.norm.cdf(
        rng.multivariate_normal([0, 0], [[1, TOGETHER], [TOGETHER, 1]], trials)
    )
    first = np.empty((trials, 2))
    for side, sign in enumerate((1, -1)):
        own = sign * velocity * looks
        for at, one in CLASSES.items():
            there = np.isclose(own, at)
            first[there, side] = np.interp(uniform[there, side], *one.knots)
    return Acts(velocity, first, first.copy(), np.arange(trials))


def biased(acts) -> Acts:
    """The left driver accelerates more, the right one less."""
    first = acts.first + np.array([0.15, -0.15])
    return replace(acts, first=first, second=first)


def late(acts) -> Acts:
    """Nothing is done for 300 ms: the first step of 200 ms holds, and a second has 700 ms."""
    return replace(acts, first=np.zeros_like(acts.first), second=0.7 * acts.first)


def studies(seed, make):
    """The faults that are named in each study of a policy."""
    rng = np.random.default_rng(seed)
    return [
        {one.name for one in faults(make(rng), published_humans()) if one.shown}
        for _ in range(STUDIES)
    ]


def test_the_published_distributions_have_the_published_shares_and_means():
    for velocity, one in CLASSES.items():
        at, value = one.knots
        sample = np.interp((np.arange(100_000) + 0.5) / 100_000, at, value)
        assert np.all(np.diff(at) > 0)
        assert np.all(np.diff(value) > 0), velocity
        assert sample.mean() == pytest.approx(one.mean, abs=1e-3)
        assert (sample < -0.2).mean() == pytest.approx(one.slow, abs=1e-4)
        assert (sample > 0.2).mean() == pytest.approx(one.go, abs=1e-4)
        assert one.slow + one.hold + one.go == pytest.approx(1, abs=2e-3)
        # Straight lines spread a little more than what lies between the quantiles.
        assert one.sd - 0.02 < sample.std() < 1.22 * one.sd


def test_the_published_slope_is_that_of_the_published_means():
    slope = published("human_first_action_trials").set_index("measure")["value"].astype(str)
    weights = np.array([one.n for one in CLASSES.values()])
    means = np.array([one.mean for one in CLASSES.values()])
    fitted = np.polyfit(list(CLASSES), means, 1, w=np.sqrt(weights))[0]
    assert fitted == pytest.approx(float(slope["slope_mps2_per_mps"]), abs=1e-3)
    assert published_humans().slope.bounds() == pytest.approx((-0.375, -0.301), abs=1e-9)


@pytest.mark.slow
def test_a_copy_of_the_humans_is_called_different_in_at_most_8_percent_of_studies():
    named = studies(1, lambda rng: drawn(rng, SITUATIONS // 2))
    assert sum(map(bool, named)) <= 0.08 * STUDIES


@pytest.mark.parametrize(
    ("fault", "make"),
    [
        (CUE, lambda rng: drawn(rng, SITUATIONS // 2, looks=False)),
        (SIDE, lambda rng: biased(drawn(rng, SITUATIONS // 2))),
        (LATE, lambda rng: late(drawn(rng, SITUATIONS // 2))),
    ],
)
def test_a_planted_fault_is_named_and_no_other(fault, make):
    named = studies(2, make)
    assert sum(fault in one for one in named) >= 0.9 * STUDIES
    others = [one - {fault} for one in named]
    assert sum(map(bool, others)) <= 0.08 * STUDIES


def test_a_driver_that_often_does_nothing_at_all_is_not_late():
    acts = drawn(np.random.default_rng(4), SITUATIONS // 2)
    first = np.where(np.arange(len(acts.first))[:, None] % 2, acts.first, 0.0)
    rounded = first * (1 + 4e-16)  # as the mean of a second is
    assert (np.abs(rounded) > np.abs(first)).any()
    found = faults(replace(acts, first=first, second=rounded), published_humans())
    (late_one,) = (one for one in found if one.name == LATE)
    assert late_one.found.p < 0.001  # it holds more often than humans
    assert (late_one.p, late_one.shown) == (1, False)


@pytest.mark.slow
def test_a_driver_that_accelerates_less_in_every_situation_is_named_for_its_level():
    named = studies(3, lambda rng: lower(drawn(rng, SITUATIONS // 2)))
    assert sum(one == {LEVEL} for one in named) >= 0.9 * STUDIES


def lower(acts) -> Acts:
    return replace(acts, first=acts.first - 0.2, second=acts.second - 0.2)


@pytest.mark.long
def test_intervals_cover_the_truth_in_93_to_97_percent():
    rng = np.random.default_rng(4)
    true_slope = np.polyfit(*zip(*((v, o.mean) for v, o in CLASSES.items()), strict=True), 1)[0]
    repeats, covered = 1000, np.zeros(3)
    for _ in range(repeats):
        driver, human = drawn(rng, 198), humans_from(drawn(rng, 495), "drawn")
        slope, side = cue(driver)
        found = {one.name: one.found for one in faults(driver, human)}
        covered += [
            np.prod(np.subtract(slope.bounds(), true_slope)) < 0,
            np.prod(side.bounds()) < 0,
            np.prod(found[CUE].bounds()) < 0,
        ]
    assert np.all((covered / repeats > 0.93) & (covered / repeats < 0.97)), covered / repeats


def test_errors_are_those_of_pairs_where_pairs_are_known():
    rng = np.random.default_rng(5)
    acts = drawn(rng, 900)
    pair = np.repeat(np.arange(9), 100)
    apart = (
        acts.first
        + rng.normal(0, 0.4, 9)[pair][:, None]
        * [1, -1]
        * np.sign(acts.relative_velocity + 1e-9)[:, None]
    )
    by_trial = cue(replace(acts, first=apart))[0]
    by_pair = cue(replace(acts, first=apart, unit=pair))[0]
    assert by_trial.value == pytest.approx(by_pair.value)
    assert by_pair.se > 2 * by_trial.se
    assert by_pair.freedom == 8


def test_a_copy_scores_at_the_ceiling_and_one_that_does_not_look_at_the_floor():
    rng = np.random.default_rng(6)
    copies = [skill(drawn(rng, 200), published_humans()) for _ in range(STUDIES)]
    assert np.mean([one.crps for one in copies]) == pytest.approx(1, abs=0.05)
    assert np.mean([one.wasserstein for one in copies]) == pytest.approx(1, abs=0.05)
    inside = [one.humans[0] <= one.wasserstein <= one.humans[1] for one in copies]
    assert np.mean(inside) >= 0.9
    blind = [skill(drawn(rng, 200, looks=False), published_humans()) for _ in range(20)]
    assert np.mean([one.wasserstein for one in blind]) == pytest.approx(0, abs=0.15)


def test_where_floor_and_ceiling_meet_there_is_no_skill():
    equal = replace(drawn(np.random.default_rng(9), 90), relative_velocity=np.zeros(90))
    assert skill(equal, humans_from(equal, "of equal velocities alone")) is None


def test_a_single_human_trial_is_no_reference_that_a_test_could_use():
    rng = np.random.default_rng(10)
    known = humans_from(drawn(rng, 1), "one trial")
    named = [one.name for one in faults(drawn(rng, 55), known)]
    assert CUE not in named
    assert LEVEL not in named


def test_distances_are_those_of_scipy():
    rng = np.random.default_rng(7)
    first, second = rng.normal(0, 1, 80).round(2), rng.normal(0.3, 0.8, 60).round(2)
    squares, wasserstein = distances(ecdf(first), ecdf(second))
    assert wasserstein == pytest.approx(stats.wasserstein_distance(first, second), abs=1e-9)
    assert np.sqrt(2 * squares) == pytest.approx(stats.energy_distance(first, second), abs=1e-9)
    assert len(GRID) == 1001
    assert published_humans().source == PUBLISHED
