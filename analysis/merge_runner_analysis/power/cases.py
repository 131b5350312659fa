"""Simulated tests of one driver, and of one level against another."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache, partial
from typing import NamedTuple

import numpy as np
import pandas as pd

from merge_runner.records import Side
from merge_runner.study.file import Effect
from merge_runner_analysis.power.truth import (
    Truth,
    chance_left_first,
    draw,
    expected_trials,
    human,
    human_sample,
    image,
    simulate,
)
from merge_runner_analysis.stats import regressions
from merge_runner_analysis.stats.contrasts import contrast_means, contrast_rates, shared_cells
from merge_runner_analysis.stats.indicators import TESTED, judge
from merge_runner_analysis.stats.sides import read_twice
from merge_runner_analysis.wording import ALPHA

# By question about one driver: its table, the number of a truth that it is about, and its unit.
QUESTIONS = {
    "I1": ("who-first", "projected_headway", "per m"),
    "I2": ("who-first", "relative_velocity", "per m/s"),
    "I3": ("gap", "abs_projected_headway", "m per m"),
    "I4": ("gap", "abs_relative_velocity", "m per m/s"),
    "projected headway": ("verdicts", "projected_headway", "per m"),
    "relative velocity": ("verdicts", "relative_velocity", "per m/s"),
    "collisions": ("verdicts", "collided", "of 1"),
}


class Endpoint(NamedTuple):
    """A measure of simulated trials: column, unit, and the keys of an [effect] that change it."""

    column: str
    unit: str
    changed_by: tuple[str, ...]


ENDPOINTS = {
    "goes first": Endpoint("left_first", "points", ("goes_first", *regressions.WHO_FIRST_TERMS)),
    "collisions": Endpoint("collided", "points", ("collided",)),
    "gap": Endpoint("gap_m", "m", ("gap_m",)),
}


class Assumed(NamedTuple):
    """An assumed effect: its table, its size with the unit, and its source."""

    table: str
    effect: float
    unit: str
    by: str = ""


@dataclass(frozen=True, slots=True)
class Case:
    """A driver with an assumed behaviour and number of trials, tested alone or against humans."""

    driver: Truth
    conditions: tuple[str, ...]
    repetitions: int
    against: str = ""

    @property
    def truth(self) -> str:
        """Name of the driver's assumed behaviour."""
        return self.driver.name

    @property
    def trials(self) -> int:
        """Number of trials that its driver plays."""
        return self.repetitions * len(self.conditions)

    def effects(self) -> dict[str, Assumed]:
        """Return by question the assumed effect; I4 assumes a small one."""
        sizes = {}
        for question, (table, number, unit) in QUESTIONS.items():
            if (question in TESTED) is not bool(self.against):
                reference = getattr(human(), number) if self.against else 0.0
                sizes[question] = Assumed(table, getattr(self.driver, number) - reference, unit)
        return {question: size for question, size in sizes.items() if size.effect}

    def detected(self, multiple: float, rng: np.random.Generator) -> dict[str, bool]:
        """Return by question whether one simulated study, ``multiple`` times as large, shows it."""
        trials = simulate(self.driver, self.conditions, round(multiple * self.repetitions), rng)
        if not self.against:
            gap = regressions.gap_ols(trials, robust=True)
            judged = judge(regressions.who_first_firth(trials), gap, robust=True)
            return {name: judgement.passed is True for name, judgement in judged.items()}
        slopes = regressions.who_first_firth(trials, less=human_sample()).terms
        cells = shared_cells(trials, human_sample(), "collided")
        p = {name.replace("_", " "): slope.p for name, slope in slopes.items()}
        p["collisions"] = cells.p if cells else 1.0
        return {question: value < ALPHA for question, value in p.items()}


@dataclass(frozen=True, slots=True)
class Played:
    """An arm's trials as its ego sees them; either of ``equal`` drivers may be focal."""

    cell: str
    side: Side
    equal: bool
    conditions: tuple[str, ...]
    repetitions: int
    truth: Truth

    def trials(self, multiple: float, *, sides: bool) -> pd.DataFrame:
        """Return a multiple of its trials by cell; with an ``image`` they count for both sides."""
        trials = expected_trials(self.truth, self.conditions, round(multiple * self.repetitions))
        names, images = trials["condition"], pd.Series(None, trials.index, dtype=object)
        if sides and self.equal:
            images = names.map(partial(image, conditions=self.conditions)) + f" right{self.cell}"
        of_side = f" {self.side}" if sides else ""
        return trials.assign(condition=names + of_side + self.cell, image=images)

    def with_default(self, measure: str) -> Played:
        """Return it with the effect that is assumed where nothing says one of a measure."""
        collided = self.truth.collided
        effects = {
            "goes first": Effect(goes_first=0.15),
            "collisions": Effect(collided=min(collided, 1 - collided)),
            "gap": Effect(gap_m=1.0),
        }
        return replace(self, truth=self.truth.plus(effects[measure], self.conditions))


@lru_cache(maxsize=8)
def _level(level: tuple[Played, ...], multiple: float, *, sides: bool) -> pd.DataFrame:
    return pd.concat([part.trials(multiple, sides=sides) for part in level], ignore_index=True)


@dataclass(frozen=True, slots=True)
class Contrast:
    """A level against its reference in one of ENDPOINTS; ``assumed`` is its effect's source."""

    level: tuple[Played, ...]
    reference: tuple[Played, ...]
    measure: str
    assumed: str
    one_sided: bool = False

    @property
    def truth(self) -> str:
        """Name of the assumed behaviour of the level's driver."""
        return self.level[0].truth.name

    @property
    def trials(self) -> int:
        """Number of trials of the level."""
        return sum(part.repetitions * len(part.conditions) for part in self.level)

    def _levels(self, multiple: float) -> list[pd.DataFrame]:
        """Return both levels; cells of who goes first have sides if one driver has a level."""
        sides = self.one_sided and self.measure == "goes first"
        return [_level(level, multiple, sides=sides) for level in (self.level, self.reference)]

    @property
    def size(self) -> float:
        """The assumed difference in the unit of the measure, with the weights of its test."""
        column, means = ENDPOINTS[self.measure].column, []
        for trials in self._levels(1):
            expected = trials.assign(left_first=chance_left_first(trials))
            means.append(_by_cell(expected, column).groupby("condition")["value"])
        (level, n), (reference, m) = ((values.mean(), values.size()) for values in means)
        weights = (n * m / (n + m)).dropna()
        unit = 1 if self.measure == "gap" else 100
        return unit * float((level - reference).dropna() @ weights / weights.sum())

    def effects(self) -> dict[str, Assumed]:
        """Return the assumed effect."""
        unit = ENDPOINTS[self.measure].unit
        return {self.measure: Assumed("effects", self.size, unit, self.assumed)}

    def detected(self, multiple: float, rng: np.random.Generator) -> dict[str, bool]:
        """Return whether one simulated study, ``multiple`` times this size, shows a difference."""
        column = ENDPOINTS[self.measure].column
        level, reference = (
            _by_cell(draw(trials, rng), column) for trials in self._levels(multiple)
        )
        if self.measure == "gap":
            estimate = contrast_means(level, reference, "value")
        else:
            cells = shared_cells(level, reference, "value")
            estimate = contrast_rates(cells) if cells else None
        p = estimate.p if estimate else None
        return {self.measure: p is not None and p < ALPHA}


def _by_cell(trials: pd.DataFrame, column: str) -> pd.DataFrame:
    values = trials[column].astype(float)
    frame = pd.DataFrame({"condition": trials["condition"], "value": values, "row": trials.index})
    return read_twice(frame, trials["image"])
