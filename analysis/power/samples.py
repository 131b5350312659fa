"""Simulated data sets of one arm of a study, and their fits."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from analysis.data.reference_data import HUMAN_TRIALS, published
from analysis.power.truths import Truth
from analysis.stats.many_fits import Array, Draws, Fits, firth_fits, gap_fits
from merge_runner.records import SIDES
from merge_runner.scenarios.merge.conditions import HUMAN_CONDITIONS


@dataclass(frozen=True, slots=True)
class Conditions:
    """The conditions of a study: projected headways in m and relative speeds in m/s."""

    headways_m: tuple[float, ...]
    velocities_mps: tuple[float, ...]


@dataclass(frozen=True, eq=False)
class Sample:
    """Data sets of the same size: sums per condition, and how many trials ``collided`` in each.

    ``trials`` is how many there are in a data set, those that collided among them.
    """

    draws: Draws
    collided: NDArray[np.int64]
    trials: int

    @cached_property
    def firth(self) -> Fits:
        """Who merges first."""
        return firth_fits(self.draws)

    @cached_property
    def gap(self) -> Fits:
        """The gap, with HC3 errors."""
        return gap_fits(self.draws)[1]


def simulate(
    truth: Truth, conditions: Conditions, repetitions: int, sets: int, seed: tuple[int, ...]
) -> Sample:
    """``sets`` data sets of so many trials in each condition; equal seeds give equal ones."""
    rng = np.random.default_rng(seed)
    headways, velocities = np.array(conditions.headways_m), np.array(conditions.velocities_mps)
    shape = sets, len(headways)
    blank = np.zeros(shape)
    design = Draws(blank, blank, blank, blank, headways, velocities)
    n = rng.binomial(repetitions, 1 - truth.collided, shape)
    left = rng.binomial(n, truth.chances_left(design.logit_design))
    # Of n normal gaps the mean is normal, and the sum of squares about it chi-squared, apart.
    sums = n * (design.gap_design @ np.array(truth.gap))
    sums += truth.gap_sd_m * np.sqrt(n) * rng.standard_normal(shape)
    about = truth.gap_sd_m**2 * np.where(n > 1, rng.chisquare(np.maximum(n - 1, 1)), 0)
    squares = about + sums**2 / np.maximum(n, 1)
    trials = repetitions * len(headways)
    finished: Array = n.astype(float)
    draws = Draws(finished, left.astype(float), sums, squares, headways, velocities)
    return Sample(draws, trials - n.sum(axis=1), trials)


def human_sample(sets: int) -> Sample:
    """The one data set of humans that there is, ``sets`` times and without gaps."""
    counts = published("human_outcomes")
    left, right = (counts[f"{side}_first"].to_numpy(float) for side in SIDES)
    drawn = [HUMAN_CONDITIONS[name] for name in counts["condition"]]
    blank = np.zeros((sets, len(left)))
    draws = Draws(
        blank + left + right,
        blank + left,
        blank,
        blank,
        np.array([each.projected_headway_m for each in drawn]),
        np.array([each.relative_velocity_mps for each in drawn]),
    )
    collided = np.full(sets, counts["collided"].sum())
    return Sample(draws, collided, HUMAN_TRIALS)
