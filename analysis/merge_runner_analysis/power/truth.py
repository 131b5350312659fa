"""Assumed behaviour of drivers, and the trials that they play by it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache

import numpy as np
import pandas as pd
from scipy import optimize, stats
from scipy.special import expit

from merge_runner.scenarios.merge.conditions import CONDITIONS
from merge_runner.study.file import Effect
from merge_runner_analysis.grouping import Group
from merge_runner_analysis.published import HUMAN_GAP_SD_M, human_outcomes, published
from merge_runner_analysis.stats import regressions
from merge_runner_analysis.stats.estimate import Array
from merge_runner_analysis.stats.indicators import fits
from merge_runner_analysis.stats.sides import MIRRORED, mirrored_name

NORMAL = stats.norm.ppf((np.arange(99) + 0.5) / 99)  # evenly likely draws


@dataclass(frozen=True, slots=True)
class Truth:
    """Assumed behaviour of a driver: coefficients of Tables III and IV, and the rest.

    ``gap_sd_m`` and ``noise`` are standard deviations of gaps and logits, ``collided`` is a share.
    """

    name: str
    gap_sd_m: float
    collided: float
    noise: float
    intercept: float
    projected_headway: float
    relative_velocity: float
    gap_m: float
    abs_projected_headway: float
    abs_relative_velocity: float
    headway_x_velocity: float

    @property
    def logit(self) -> Array:
        """The coefficients of who merges first."""
        return np.array([self.intercept, self.projected_headway, self.relative_velocity])

    @property
    def gap(self) -> Array:
        """The coefficients of the gap in m."""
        slopes = (self.abs_projected_headway, self.abs_relative_velocity, self.headway_x_velocity)
        return np.array([self.gap_m, *slopes])

    def first(self, conditions: Sequence[str]) -> Array:
        """Return the chance of the left driver to go first in each condition."""
        return chance_left_first(expected_trials(self, conditions))

    def plus(self, effect: Effect, conditions: Sequence[str]) -> Truth:
        """Return the truth with an effect; ``goes_first`` shifts the mean over conditions."""
        added = {name: value for name, value in effect if name != "goes_first"}
        more = replace(self, **{name: getattr(self, name) + value for name, value in added.items()})
        if not effect.goes_first:
            return more
        target = float(np.clip(more.first(conditions).mean() + effect.goes_first, 0.001, 0.999))

        def missing(shift: float) -> float:
            shifted = replace(more, intercept=more.intercept + shift)
            return float(shifted.first(conditions).mean()) - target

        return replace(more, intercept=more.intercept + optimize.brentq(missing, -50, 50))


def chance_left_first(trials: pd.DataFrame) -> Array:
    """Return the mean chance of each trial over the noise of its logit."""
    noise = trials["noise"].to_numpy()[:, None] * NORMAL
    return np.asarray(expit(trials["logit"].to_numpy()[:, None] + noise).mean(axis=1))


@cache
def human_sample() -> pd.DataFrame:
    """Return the published outcomes; the gap of no single trial is published."""
    return human_outcomes().rename(columns={"collided_boxes": "collided"}).assign(gap_m=np.nan)


@cache
def human() -> Truth:
    """Return the humans as they are published."""
    tables = [published(name) for name in ("paper_who_first", "paper_gap")]
    b = pd.concat(table[table["driver"] == "human"]["b"] for table in tables).astype(float)
    collided = float(human_sample()["collided"].mean())
    return Truth("human", HUMAN_GAP_SD_M, collided, 0.0, *b)


def played(group: Group) -> Truth | None:
    """Return a driver's behaviour in its trials; None if they are too few for all coefficients."""
    b = [term.b for fit in (fits(group).firth, fits(group).ols) for term in fit.terms.values()]
    if len(b) < len(regressions.WHO_FIRST_TERMS + regressions.GAP_TERMS):
        return None
    design, gap_m, _ = regressions.gap_data(group.trials)
    scatter = np.linalg.norm(gap_m - design @ b[3:]) / fits(group).ols.freedom ** 0.5
    collided = group.ended["status"].eq("collided").mean()
    return Truth(f"{group.id} as played", float(scatter), float(collided), 0.0, *b)


def expected_trials(truth: Truth, conditions: Sequence[str], repetitions: int = 1) -> pd.DataFrame:
    """Return trials with their expected outcomes: logits, gaps in m, shares that collide."""
    signs = np.array([-1 if name.endswith(MIRRORED) else 1 for name in conditions])
    known = [CONDITIONS[name.removesuffix(MIRRORED)] for name in conditions]
    headway_m = signs * np.array([condition.projected_headway_m for condition in known])
    velocity_mps = signs * np.array([condition.relative_velocity_mps for condition in known])
    logit = np.column_stack([np.ones(len(known)), headway_m, velocity_mps]) @ truth.logit
    trials = pd.DataFrame(
        {
            "condition": list(conditions),
            "projected_headway_m": headway_m,
            "relative_velocity_mps": velocity_mps,
            "collided": truth.collided,
            "logit": logit,
            "noise": truth.noise,
            "gap_m": regressions.gap_design(headway_m, velocity_mps) @ truth.gap,
            "gap_sd_m": truth.gap_sd_m,
        }
    )
    return trials.loc[trials.index.repeat(max(1, repetitions))].reset_index(drop=True)


def draw(trials: pd.DataFrame, rng: np.random.Generator) -> pd.DataFrame:
    """Return ``expected_trials`` with outcomes drawn by chance."""
    n = len(trials)
    collided = rng.random(n) < trials["collided"]
    first = rng.random(n) < expit(trials["logit"] + trials["noise"] * rng.standard_normal(n))
    gap_m = trials["gap_m"] + trials["gap_sd_m"] * rng.standard_normal(n)
    left_first = first.astype(float).mask(collided)
    return trials.assign(collided=collided, left_first=left_first, gap_m=gap_m.mask(collided))


def image(condition: str, conditions: Sequence[str]) -> str:
    """Return a condition as the driver on the right sees it, named as one of these if it can be."""
    if condition.endswith(MIRRORED):
        return condition.removesuffix(MIRRORED)
    named = {name: CONDITIONS[name] for name in conditions if not name.endswith(MIRRORED)}
    numbers = {n: (at.projected_headway_m, at.relative_velocity_mps) for n, at in named.items()}
    return mirrored_name(condition, numbers)


def simulate(
    truth: Truth, conditions: Sequence[str], repetitions: int, rng: np.random.Generator
) -> pd.DataFrame:
    """Return ``repetitions`` trials of each condition, with the columns of ``load_trials``."""
    trials = draw(expected_trials(truth, conditions, repetitions), rng)
    return trials.assign(
        status=np.where(trials["collided"], "collided", "finished"),
        merged_first=np.where(trials["left_first"] == 1, "left", "right"),
    )
