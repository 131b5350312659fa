"""What a perfect human clone would score: the indicators on resampled human data of a given size.

Each data set draws, per condition, as many human trials as the model has. Before human traces are
imported, outcomes come from the published counts and gaps from the published regression with normal
residuals; afterwards whole trials are resampled. All data sets are fitted at once
(``many_fits``), and ``indicators`` judges the fits.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np
import pandas as pd

from merge_runner.scenarios.merge.conditions import HUMAN_CONDITIONS
from merge_runner_analysis.data.reference_data import HUMAN_GAP_SD_M, human_outcomes, published
from merge_runner_analysis.stats.indicators import PAPER, ROBUST
from merge_runner_analysis.stats.many_fits import (
    HEADWAYS,
    VELOCITIES,
    Array,
    Draws,
    Passes,
    firth_fits,
    gap_fits,
    logit_fits,
    passes,
)
from merge_runner_analysis.stats.regressions import gap_design

SEED = 260409609
DATA_SETS = 1000


@dataclass(frozen=True, eq=False)
class Population:
    """Human trials by condition, in the order of HUMAN_CONDITIONS, one array each.

    ``left``: 1 or 0 for who merged first, NaN after a collision. ``gap_m``: NaN after a collision.
    Without traces the last is empty.
    """

    left: tuple[Array, ...]
    gap_m: tuple[Array, ...] = ()


@dataclass(frozen=True, slots=True)
class Ceiling:
    """Shares of human data sets that pass each indicator, and I1 to I4 together (``I1-I4``)."""

    paper: dict[str, float]
    robust: dict[str, float]


@cache
def published_humans() -> Population:
    """The humans as far as they are published: counts, and the regression of their gaps."""
    return Population(left=_by_condition(human_outcomes(), _left(human_outcomes())))


def imported_humans(trials: pd.DataFrame) -> Population:
    """The humans as imported, from rows of ``load_trials``."""
    return Population(
        left=_by_condition(trials, _left(trials)),
        gap_m=_by_condition(trials, trials["gap_m"]),
    )


@cache
def ceiling(humans: Population, sizes: tuple[int, ...]) -> Ceiling:
    """The human ceiling for ``sizes`` trials per condition, in the order of HUMAN_CONDITIONS.

    Without a trial there is nothing to draw, and no share.
    """
    if not sum(sizes):
        return Ceiling({}, {})
    draws = drawn(humans, sizes)
    ols, hc3 = gap_fits(draws)
    return Ceiling(
        _shares(passes(PAPER, logit_fits(draws), ols)),
        _shares(passes(ROBUST, firth_fits(draws), hc3)),
    )


def _shares(passed: Passes) -> dict[str, float]:
    together = np.logical_and.reduce(list(passed.values()))
    return {name: float(each.mean()) for name, each in (passed | {"I1-I4": together}).items()}


def drawn(humans: Population, sizes: Sequence[int]) -> Draws:
    """DATA_SETS human data sets of ``sizes`` trials, with replacement; some of them collide."""
    rng = np.random.default_rng(SEED)
    n, left, gap, squared_gap = np.zeros((4, DATA_SETS, len(HUMAN_CONDITIONS)))
    expected = gap_design(HEADWAYS, VELOCITIES) @ published_gap()
    for i, size in enumerate(sizes):
        if size == 0 or len(humans.left[i]) == 0:
            continue
        trials = rng.integers(0, len(humans.left[i]), (DATA_SETS, size))
        who = humans.left[i][trials]
        gap_m = (
            humans.gap_m[i][trials]
            if humans.gap_m
            else expected[i] + HUMAN_GAP_SD_M * rng.standard_normal((DATA_SETS, size))
        )
        finished = np.isfinite(who)
        n[:, i] = finished.sum(axis=1)
        left[:, i] = np.where(finished, who, 0).sum(axis=1)
        gap[:, i] = np.where(finished, gap_m, 0).sum(axis=1)
        squared_gap[:, i] = np.where(finished, gap_m**2, 0).sum(axis=1)
    return Draws(n, left, gap, squared_gap)


def published_gap() -> Array:
    """The coefficients of the human gaps (arXiv 2604.09609, Table IV)."""
    human = published("paper_gap").query("driver == 'human'")
    return np.asarray(human["b"], dtype=float)


def _left(trials: pd.DataFrame) -> pd.Series:
    left = (trials["merged_first"] == "left").astype(float)
    return left.where((trials["status"] == "finished") & trials["merged_first"].notna())


def _by_condition(trials: pd.DataFrame, values: pd.Series) -> tuple[Array, ...]:
    return tuple(values[trials["condition"] == name].to_numpy(float) for name in HUMAN_CONDITIONS)
