"""The chances of a study to find effects: simulated trials, judged by the tests of the tables."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cache, partial
from typing import NamedTuple

import numpy as np
import pandas as pd
from scipy import optimize, stats
from scipy.special import expit

from merge_runner.config import validated
from merge_runner.planted_effect import PlantedEffect, planted_fields
from merge_runner.prompts.blocks import BASELINE
from merge_runner.run.estimate import typical_prompt
from merge_runner.run.plan import Plan
from merge_runner.scenarios.merge.conditions import CONDITIONS
from merge_runner.study.crossing import MODEL, PROMPT, Arm
from merge_runner.study.file import Effect
from merge_runner_analysis.grouping import Group
from merge_runner_analysis.published import HUMAN_GAP_SD_M, human_outcomes, published
from merge_runner_analysis.stats import regressions
from merge_runner_analysis.stats.contrasts import contrast_means, contrast_rates, shared_cells
from merge_runner_analysis.stats.indicators import ALPHA, TESTED, fits, judge
from merge_runner_analysis.stats.intervals import POWER
from merge_runner_analysis.tables.model import Column, Row, Table, Value

COEFFICIENTS = 7  # of a truth: of who merges first, and of the gap
MULTIPLES = (0.5, 1.0, 2.0, 4.0)
SEED = 260409609
NORMAL = stats.norm.ppf((np.arange(99) + 0.5) / 99)  # evenly likely draws
HUMANS = "humans"
VERDICTS = "verdicts"  # the table that compares with the humans
EFFECTS = "effects"  # the table that compares levels of factors
# By question about one driver: its table, the number of a truth that it is about, and its unit.
QUESTIONS = {
    "I1": ("who-first", "projected_headway", "per m"),
    "I2": ("who-first", "relative_velocity", "per m/s"),
    "I3": ("gap", "abs_projected_headway", "m per m"),
    "I4": ("gap", "abs_relative_velocity", "m per m/s"),
    "projected headway": (VERDICTS, "projected_headway", "per m"),
    "relative velocity": (VERDICTS, "relative_velocity", "per m/s"),
    "collisions": (VERDICTS, "collided", "of 1"),
}
# By measure of an effect: its column of simulated trials, and its unit.
MEASURES = {
    "goes first": ("left_first", "points"),
    "collisions": ("collided", "points"),
    "gap": ("gap_m", "m"),
}
NOTHING = 1e-6  # an effect that is no more than this is none
COLUMNS = (
    Column("table", "table", noted=True),
    Column("question", "question"),
    Column("arms", "level"),
    Column("against", "against", optional=True),
    Column("truth", "truth"),
    Column("effect", "effect", "number"),
    Column("unit", "unit"),
    Column("trials", "n", "count"),
    *(Column(f"times_{m:g}", f"x{m:g}", "percent", digits=0) for m in MULTIPLES),
    Column("enough", "n for 80 %", "count", optional=True),
    Column("cost_usd", "USD", "number", optional=True),
)


@dataclass(frozen=True, slots=True)
class Truth:
    """How a driver drives, as it is assumed: coefficients of Tables III and IV, and the rest."""

    name: str
    gap_sd_m: float
    """By which gaps scatter normally."""
    collided: float
    """The share of trials that end in a collision."""
    noise: float
    """By which the logits of trials scatter."""
    intercept: float
    projected_headway: float
    relative_velocity: float
    gap_m: float
    abs_projected_headway: float
    abs_relative_velocity: float
    headway_x_velocity: float

    @property
    def logit(self) -> regressions.Array:
        """The coefficients of who merges first."""
        return np.array([self.intercept, self.projected_headway, self.relative_velocity])

    @property
    def gap(self) -> regressions.Array:
        """The coefficients of the gap in m."""
        slopes = (self.abs_projected_headway, self.abs_relative_velocity, self.headway_x_velocity)
        return np.array([self.gap_m, *slopes])

    def first(self, conditions: Sequence[str]) -> regressions.Array:
        """The chance of the left driver to go first in each condition."""
        h, dv = _numbers(conditions)
        logit = np.column_stack([np.ones(len(h)), h, dv]) @ self.logit
        return np.asarray(expit(logit[:, None] + self.noise * NORMAL).mean(axis=1))

    def measures(self, conditions: Sequence[str]) -> dict[str, float]:
        """What trials of these conditions come to by MEASURES, in the unit of each."""
        gaps_m = regressions.gap_design(*_numbers(conditions)) @ self.gap
        return {
            "goes first": 100 * float(self.first(conditions).mean()),
            "collisions": 100 * self.collided,
            "gap": float(gaps_m.mean()),
        }

    def plus(self, effect: Effect, conditions: Sequence[str]) -> Truth:
        """Return the truth with an effect; of who goes first it is one on the mean over these.

        As far as that can be: in no condition is a share more than 1.
        """
        added = {name: value for name, value in effect if name != "goes_first"}
        more = replace(self, **{name: getattr(self, name) + value for name, value in added.items()})
        if not effect.goes_first:
            return more
        wanted = float(np.clip(more.first(conditions).mean() + effect.goes_first, 0.001, 0.999))

        def missing(shift: float) -> float:
            shifted = replace(more, intercept=more.intercept + shift)
            return float(shifted.first(conditions).mean()) - wanted

        return replace(more, intercept=more.intercept + optimize.brentq(missing, -50, 50))


@cache
def human_trials() -> pd.DataFrame:
    """Return the published outcomes; the gap of no single trial is published."""
    return human_outcomes().rename(columns={"collided_boxes": "collided"}).assign(gap_m=np.nan)


def human() -> Truth:
    """Return the humans as they are published."""
    tables = [published(name) for name in ("paper_who_first", "paper_gap")]
    b = pd.concat(table[table["driver"] == "human"]["b"] for table in tables).astype(float)
    collided = float(human_trials()["collided"].mean())
    return Truth("human", HUMAN_GAP_SD_M, collided, 0.0, *b)


def played(group: Group) -> Truth | None:
    """Return a driver as its trials went; None where these are too few for all coefficients."""
    b = [term.b for fit in (fits(group).firth, fits(group).ols) for term in fit.terms.values()]
    if len(b) < COEFFICIENTS:
        return None
    design, gap_m, _ = regressions.gap_data(group.trials)
    scatter = np.linalg.norm(gap_m - design @ b[3:]) / fits(group).ols.freedom ** 0.5
    collided = group.ended["status"].eq("collided").mean()
    return Truth(f"{group.id} as played", float(scatter), float(collided), 0.0, *b)


def _numbers(conditions: Iterable[str]) -> tuple[regressions.Array, regressions.Array]:
    """Headways in m and relative velocities in m/s."""
    found = [CONDITIONS[name] for name in conditions]
    return (
        np.array([one.projected_headway_m for one in found]),
        np.array([one.relative_velocity_mps for one in found]),
    )


def simulate(
    truth: Truth, conditions: Sequence[str], repetitions: int, rng: np.random.Generator
) -> pd.DataFrame:
    """Return so many trials of each condition, with the columns of ``load_trials``."""
    names = np.repeat(list(conditions), max(1, repetitions))
    h, dv = _numbers(names)
    collided = rng.random(len(names)) < truth.collided
    logit = np.column_stack([np.ones(len(names)), h, dv]) @ truth.logit
    left = rng.random(len(names)) < expit(logit + truth.noise * rng.standard_normal(len(names)))
    scatter_m = truth.gap_sd_m * rng.standard_normal(len(names))
    gap_m = regressions.gap_design(h, dv) @ truth.gap + scatter_m
    return pd.DataFrame(
        {
            "condition": names,
            "projected_headway_m": h,
            "relative_velocity_mps": dv,
            "status": np.where(collided, "collided", "finished"),
            "merged_first": np.where(left, "left", "right"),
            "left_first": np.where(collided, np.nan, left),
            "gap_m": np.where(collided, np.nan, gap_m),
            "collided": collided,
        }
    )


def findings(own: pd.DataFrame, other: pd.DataFrame | None) -> dict[str, bool]:
    """Return by question what a driver's trials show at p < .05, alone or beside the humans."""
    if other is None:
        gap = regressions.gap_ols(own, robust=True)
        judged = judge(regressions.who_first_firth(own), gap, robust=True)
        return {name: judgement.passed is True for name, judgement in judged.items()}
    slopes = regressions.who_first_firth(own, less=other).terms
    cells = shared_cells(own, other, "collided")
    p = {name.replace("_", " "): slope.p for name, slope in slopes.items()}
    p["collisions"] = cells.p if cells else 1.0
    return {question: value < ALPHA for question, value in p.items()}


@dataclass(frozen=True, slots=True)
class Case:
    """A driver of this truth and size: by itself, or beside the humans."""

    own: Truth
    repetitions: int
    against: str = ""

    def effects(self, conditions: Sequence[str]) -> dict[str, tuple[str, float, str]]:
        """By question its table, and the effect that there is to find; that of I4 is small."""
        other, alone = human(), not self.against
        sizes = {
            question: (
                table,
                getattr(self.own, number) - (0.0 if alone else getattr(other, number)),
                unit,
            )
            for question, (table, number, unit) in QUESTIONS.items()
            if (question in TESTED) is alone
        }
        return {question: each for question, each in sizes.items() if each[1]}

    def trials(self, conditions: Sequence[str]) -> int:
        """How many its driver plays."""
        return self.repetitions * len(conditions)

    def found(
        self, conditions: Sequence[str], multiple: float, rng: np.random.Generator
    ) -> dict[str, bool]:
        """By question what one simulated study of so many times this size shows."""
        own = simulate(self.own, conditions, round(multiple * self.repetitions), rng)
        return findings(own, human_trials() if self.against else None)


@dataclass(frozen=True, slots=True)
class Contrast:
    """A level of a factor against its reference: both truths and sizes, by cell."""

    cells: tuple[tuple[Truth, int, Truth, int], ...]
    against: str

    @property
    def own(self) -> Truth:
        """What the first cell's level is supposed to be."""
        return self.cells[0][0]

    def effects(self, conditions: Sequence[str]) -> dict[str, tuple[str, float, str]]:
        """By measure its table, the mean difference that there is to find, and its unit."""
        apart: dict[str, list[float]] = {measure: [] for measure in MEASURES}
        for own, _, other, _ in self.cells:
            one, two = own.measures(conditions), other.measures(conditions)
            for measure, differences in apart.items():
                differences.append(one[measure] - two[measure])
        sizes = {name: float(np.mean(differences)) for name, differences in apart.items()}
        return {
            name: (EFFECTS, size, MEASURES[name][1])
            for name, size in sizes.items()
            if abs(size) > NOTHING
        }

    def trials(self, conditions: Sequence[str]) -> int:
        """How many trials the level has."""
        return sum(repetitions for _, repetitions, _, _ in self.cells) * len(conditions)

    def found(
        self, conditions: Sequence[str], multiple: float, rng: np.random.Generator
    ) -> dict[str, bool]:
        """By measure whether one simulated study of so many times this size shows a difference."""
        levels: tuple[list[pd.DataFrame], list[pd.DataFrame]] = ([], [])
        for number, (own, size, other, other_size) in enumerate(self.cells):
            for frames, truth, n in ((levels[0], own, size), (levels[1], other, other_size)):
                trials = simulate(truth, conditions, round(multiple * n), rng)
                frames.append(trials.assign(condition=trials["condition"] + f" {number}"))
        one, two = map(pd.concat, levels)
        p = {}
        for measure, (column, _) in MEASURES.items():
            cells = shared_cells(one, two, column) if column != "gap_m" else None
            found = contrast_rates(cells) if cells else contrast_means(one, two, column)
            p[measure] = 1.0 if found is None or found.p is None else found.p
        return {measure: value < ALPHA for measure, value in p.items()}


def power(
    case: Case | Contrast, conditions: Sequence[str], multiple: float, simulations: int
) -> dict[str, float]:
    """Return by question the share of simulated studies of so many times this size that find it."""
    rng, found = np.random.default_rng(SEED), Counter[str]()
    for _ in range(simulations):
        found.update(n for n, shown in case.found(conditions, multiple, rng).items() if shown)
    return {question: found[question] / simulations for question in case.effects(conditions)}


def chances(
    plan: Plan, cost_usd: float | None, groups: Sequence[Group], simulations: int
) -> Iterator[Row]:
    """Simulate a plan that costs so much; ``groups`` are played ones. Raises UsageError.

    Levels of factors have a row for each measure that they are supposed to change. Where they
    change none, or how drivers heed their situation, the drivers by themselves have rows.
    """
    conditions = plan.conditions
    cases = list(_cases(plan, groups))
    labels: dict[Case | Contrast, list[str]] = {}  # equal ones share rows
    for label, case in cases:
        labels.setdefault(case, []).append(label)
    for case, names in labels.items():
        effects = case.effects(conditions)
        at = {m: power(case, conditions, m, simulations) for m in MULTIPLES if effects}
        for question, (table, effect, unit) in effects.items():
            enough = next((m for m in MULTIPLES if at[m][question] >= POWER), None)
            trials = case.trials(conditions)
            key = [table, question, ", ".join(names), case.against, case.own.name]
            size = None if enough is None else round(enough * trials)
            cost = None if enough is None or cost_usd is None else enough * cost_usd
            shares: list[Value] = [100 * at[m][question] for m in MULTIPLES]
            values = [*key, effect, unit, trials, *shares, size, cost]
            yield Row("/".join(key), (), dict(zip([c.name for c in COLUMNS], values, strict=True)))


def power_table(title: str, rows: Sequence[Row]) -> Table:
    """Return the rows of ``chances`` as a table."""
    times = ", ".join(f"x{m:g}" for m in MULTIPLES)
    notes = (
        f"n: trials of the level or driver; {times}: the share of simulated studies with so many "
        "times the repetitions that find the effect at p < .05, by the test of its table (effects; "
        "I1 to I4: indicators; humans: verdicts), before any correction; n for 80 %, USD: the "
        "smallest of these sizes with this power",
        "truth: published humans, the driver as it was played, or what is planted in the emulator, "
        "with the [effect] that the study names; without one, a level goes first in 15 points "
        "more, leaves 1 m more than the reference, and collides twice as often",
    )
    return Table("power", COLUMNS, rows, notes, title=title)


class Played(NamedTuple):
    """The trials of an arm, of a pair both ways round, and how they are supposed to go."""

    label: str
    levels: dict[str, str]
    repetitions: int
    truths: list[Truth]


def _cases(plan: Plan, groups: Sequence[Group]) -> Iterator[tuple[str, Case | Contrast]]:
    played = _played(plan, groups)
    contrasts = list(_contrasts(plan, played))
    yield from contrasts
    slopes = {(one.projected_headway, one.relative_velocity) for of in played for one in of.truths}
    changed = any(case.effects(plan.conditions) for _, case in contrasts)
    if changed and len(slopes) < 2:
        return
    for of in played:
        for own in of.truths:
            yield of.label, Case(own, of.repetitions)
            yield of.label, Case(own, of.repetitions, HUMANS)


def _played(plan: Plan, groups: Sequence[Group]) -> list[Played]:
    """What is played with each choice of levels; tables pool a pair both ways round."""
    found: dict[frozenset[tuple[str, str]], Played] = {}
    for arm in plan.arms:
        levels = {MODEL: arm.model_level, PROMPT: arm.variant, **arm.factors}
        key = frozenset(levels.items())
        if key in found:
            before = found[key].repetitions
            found[key] = found[key]._replace(repetitions=before + arm.repetitions)
        else:
            truths = _truths(plan, arm, groups)
            found[key] = Played(arm.label, levels, arm.repetitions, truths)
    return [*found.values()]


def _contrasts(plan: Plan, played: Sequence[Played]) -> Iterator[tuple[str, Contrast]]:
    """Each level of each factor against its reference, in the cells that both have."""
    at = {frozenset(one.levels.items()): one for one in played}
    nothing = all(truth == human() for one in played for truth in one.truths)
    for factor in dict.fromkeys(name for one in played for name in one.levels):
        named = dict.fromkeys(one.levels[factor] for one in played if factor in one.levels)
        reference, *others = sorted(named, key=partial(_place, plan, factor))
        for level in others:
            pairs = []
            for one in played:
                twin = at.get(frozenset({**one.levels, factor: reference}.items()))
                if one.levels.get(factor) == level and twin:
                    pairs.append((one, twin))
            numbers = min((len(one.truths) for pair in pairs for one in pair), default=0)
            for number in range(numbers):
                cells = []
                for one, twin in pairs:
                    own = one.truths[number]
                    own = _supposed(plan, own) if nothing else own
                    cells.append((own, one.repetitions, twin.truths[number], twin.repetitions))
                yield f"{factor}={level}", Contrast(tuple(cells), f"{factor}={reference}")


def _place(plan: Plan, factor: str, level: str) -> int:
    """Where the study lists a level."""
    listed = plan.levels.get(factor, [])
    return listed.index(level) if level in listed else len(listed)


def _supposed(plan: Plan, truth: Truth) -> Truth:
    """What is supposed of a level where nothing is named."""
    return truth.plus(Effect(goes_first=0.15, gap_m=1.0, collided=truth.collided), plan.conditions)


def _truths(plan: Plan, arm: Arm, groups: Sequence[Group]) -> list[Truth]:
    """As planted in the emulator; or as humans and as played, with named effects.

    Where a study plants anything, an arm goes as its ego's request says, as if that were on the
    left: also one in which nothing is planted.
    """
    every = [entry for each in plan.arms for entry in each.entries.values()]
    ego = arm.entries.get(arm.names[0])
    if ego and any(planted_fields(entry.parameters) for entry in every):
        fields = planted_fields(ego.parameters)
        planted = validated(PlantedEffect, fields, "what is planted")
        planted = planted.before(typical_prompt(plan, arm))
        # The script aims at gaps from 1.8 to 6.5 m; in 1 of 33 trials two vehicles collide.
        gap = (4.15 + planted.x_gap_m, 0.0, 0.0, 0.0)
        return [Truth("as planted", 1.36, 1 / 33, planted.x_noise, *planted.coefficients, *gap)]
    named = plan.study.file.effect
    by_setting = {(group.name, group.setting): group for group in reversed(groups)}
    prompts = (BASELINE,) if PROMPT in named else (arm.variant, BASELINE)
    known = [by_setting[arm.model, p] for p in prompts if (arm.model, p) in by_setting]
    truths = [human(), *filter(None, map(played, known[:1]))]
    for factor, added in named.items():
        level = arm.variant if factor == PROMPT else arm.factors.get(factor)
        if level not in (None, plan.levels[factor][0]):
            truths = [truth.plus(added, plan.conditions) for truth in truths]
    return truths
