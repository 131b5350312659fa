"""How trials may go, and data sets that are simulated from it."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import expit

from merge_runner.planted_effect import PlantedEffect
from merge_runner.records import SIDES
from merge_runner.scenarios.merge.conditions import HUMAN_CONDITIONS
from merge_runner_analysis.data.reference_data import (
    HUMAN_GAP_SD_M,
    HUMAN_TRIALS,
    human_outcomes,
    published,
)
from merge_runner_analysis.data.study import Group
from merge_runner_analysis.stats.ceiling import SEED
from merge_runner_analysis.stats.group_scores import fits
from merge_runner_analysis.stats.many_fits import Draws, Fits, firth_fits, gap_fits
from merge_runner_analysis.stats.regressions import WHO_FIRST_TERMS, gap_data

SPEED = WHO_FIRST_TERMS.index("relative_velocity")
# The emulator's script aims at gaps from 1.8 to 6.5 m, all as likely; in one condition of every
# third repetition two vehicles collide.
SCRIPTED_GAP_M, SCRIPTED_GAP_SD_M = 4.15, 1.36
NODES, WEIGHTS = np.polynomial.hermite_e.hermegauss(41)


@dataclass(frozen=True, slots=True)
class Truth:
    """Coefficients of who merges first (Table III) and of the gap in m (Table IV).

    Gaps scatter normally by ``gap_sd_m``; ``collided`` is the share of trials that collide.
    ``noise`` is the standard deviation of what is added to the logit of each trial.
    """

    name: str
    who_first: tuple[float, ...]
    gap: tuple[float, ...]
    gap_sd_m: float
    collided: tuple[float]
    noise: float = 0.0

    def changed(self, field: str, at: int, value: float) -> Truth:
        """The same with another number."""
        numbers = list(getattr(self, field))
        numbers[at] = value
        changes: dict[str, Any] = {field: tuple(numbers)}
        return replace(self, **changes)


def human() -> Truth:
    """The humans as they are published."""
    who_first, gap = (
        tuple(map(float, published(name).query("driver == 'human'")["b"]))
        for name in ("paper_who_first", "paper_gap")
    )
    collided = float((human_outcomes()["status"] == "collided").mean())
    return Truth("human", who_first, gap, HUMAN_GAP_SD_M, (collided,))


def planted(effect: PlantedEffect) -> Truth:
    """The emulator with an effect."""
    gap = (SCRIPTED_GAP_M + effect.x_gap_m, 0.0, 0.0, 0.0)
    who_first = effect.coefficients
    return Truth("as planted", who_first, gap, SCRIPTED_GAP_SD_M, (1 / 33,), effect.x_noise)


def played(group: Group) -> Truth | None:
    """A driver as its trials went; None where these are too few to tell all coefficients."""
    who_first, gap = fits(group).firth.terms, fits(group).ols.terms
    if not (who_first and gap):
        return None
    design, measured, _ = gap_data(group.trials)
    b = tuple(term.b for term in gap.values())
    rest = measured - design @ np.array(b)
    return Truth(
        f"{group.id} as played",
        tuple(term.b for term in who_first.values()),
        b,
        float(np.sqrt(rest @ rest / fits(group).ols.freedom)),
        (float((group.ended["status"] == "collided").mean()),),
    )


@dataclass(frozen=True, slots=True)
class Conditions:
    """The conditions of a study: projected headways in m and relative velocities in m/s."""

    headways_m: tuple[float, ...]
    velocities_mps: tuple[float, ...]


@dataclass(frozen=True, eq=False)
class Sample:
    """Data sets of ``trials`` each: sums per condition, and how many ``collided`` in each set."""

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


@lru_cache(maxsize=64)
def simulate(
    truth: Truth, conditions: Conditions, repetitions: int, sets: int, seed: tuple[int, ...]
) -> Sample:
    """``sets`` data sets of so many trials in each condition; equal seeds give equal ones."""
    rng = np.random.default_rng((SEED, *seed))
    headways, velocities = np.array(conditions.headways_m), np.array(conditions.velocities_mps)
    shape = sets, len(headways)
    blank = np.zeros(shape)
    design = Draws(blank, blank, blank, blank, headways, velocities)
    n = rng.binomial(repetitions, 1 - truth.collided[0], shape)
    logit = design.logit_design @ np.array(truth.who_first)
    chances = expit(logit[:, None] + truth.noise * NODES) @ (WEIGHTS / WEIGHTS.sum())
    left = rng.binomial(n, chances)
    # Of n normal gaps the mean is normal, and the sum of squares about it chi-squared, apart.
    sums = n * (design.gap_design @ np.array(truth.gap))
    sums += truth.gap_sd_m * np.sqrt(n) * rng.standard_normal(shape)
    about = truth.gap_sd_m**2 * np.where(n > 1, rng.chisquare(np.maximum(n - 1, 1)), 0)
    squares = about + sums**2 / np.maximum(n, 1)
    draws = Draws(n.astype(float), left.astype(float), sums, squares, headways, velocities)
    trials = repetitions * len(headways)
    return Sample(draws, trials - n.sum(axis=1), trials)


@lru_cache(maxsize=1)
def human_sample(sets: int) -> Sample:
    """The one data set of humans that there is, ``sets`` times and without gaps."""
    counts = published("human_outcomes").set_index("condition").loc[list(HUMAN_CONDITIONS)]
    left, right = (counts[f"{side}_first"].to_numpy(float) for side in SIDES)
    blank = np.zeros((sets, len(left)))
    draws = Draws(blank + left + right, blank + left, blank, blank)
    return Sample(draws, np.full(sets, counts["collided"].sum()), HUMAN_TRIALS)
