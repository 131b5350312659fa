"""The chances of a study to find effects: simulated trials, judged by the tests of the tables."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cache

import numpy as np
import pandas as pd
from scipy.special import expit

from merge_runner.config import validated
from merge_runner.planted_effect import PlantedEffect, planted_fields
from merge_runner.prompts.blocks import BASELINE
from merge_runner.run.estimate import typical_prompt
from merge_runner.run.plan import Plan
from merge_runner.scenarios.merge.conditions import CONDITIONS
from merge_runner.study.crossing import PROMPT, Arm
from merge_runner.study.file import Effect
from merge_runner_analysis.grouping import Group
from merge_runner_analysis.published import HUMAN_GAP_SD_M, human_outcomes, published
from merge_runner_analysis.stats import regressions
from merge_runner_analysis.stats.contrasts import contrast_means, shared_cells
from merge_runner_analysis.stats.indicators import ALPHA, TESTED, fits, judge
from merge_runner_analysis.stats.intervals import POWER
from merge_runner_analysis.tables.model import Column, Row, Table, Value

COEFFICIENTS = 7  # of a truth: of who merges first, and of the gap
MULTIPLES = (0.5, 1.0, 2.0, 4.0)
SEED = 260409609
HUMANS = "humans"
VERDICTS = "verdicts"  # the table that compares with the humans
# By question: its table, the number of a truth that it is about, and the unit of that.
QUESTIONS = {
    "I1": ("who-first", "projected_headway", "per m"),
    "I2": ("who-first", "relative_velocity", "per m/s"),
    "I3": ("gap", "abs_projected_headway", "m per m"),
    "I4": ("gap", "abs_relative_velocity", "m per m/s"),
    "projected headway": ("who-first", "projected_headway", "per m"),
    "relative velocity": ("who-first", "relative_velocity", "per m/s"),
    "gap": ("contrasts", "gap_m", "m"),
    "collisions": ("contrasts", "collided", "of 1"),
}
COLUMNS = (
    *(Column(n, n) for n in ("table", "question", "arms", "against", "truth", "unit")),
    Column("effect", "size", "number", 2),
    Column("trials", "n", "count"),
    *(Column(f"times_{m:g}", f"x{m:g}", "percent", 0) for m in MULTIPLES),
    Column("enough", "n for 80 %", "count", optional=True),
    Column("cost_usd", "USD", "number", 2, optional=True),
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

    def plus(self, effect: Effect) -> Truth:
        """Return the truth with an effect."""
        return replace(self, **{name: getattr(self, name) + added for name, added in effect})


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


def simulate(
    truth: Truth, conditions: Sequence[str], repetitions: int, rng: np.random.Generator
) -> pd.DataFrame:
    """Return so many trials of each condition, with the columns of ``load_trials``."""
    names = np.repeat(list(conditions), max(1, repetitions))
    h = np.array([CONDITIONS[name].projected_headway_m for name in names])
    dv = np.array([CONDITIONS[name].relative_velocity_mps for name in names])
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
            "gap_m": np.where(collided, np.nan, gap_m),
            "collided": collided,
        }
    )


def findings(own: pd.DataFrame, other: pd.DataFrame | None) -> dict[str, bool]:
    """Return by question what trials show at p < .05: the indicators, or how two groups differ."""
    if other is None:
        gap = regressions.gap_ols(own, robust=True)
        judged = judge(regressions.who_first_firth(own), gap, robust=True)
        return {name: judgement.passed is True for name, judgement in judged.items()}
    slopes = regressions.who_first_firth(own, less=other).terms
    gaps, cells = contrast_means(own, other, "gap_m"), shared_cells(own, other, "collided")
    p = {name.replace("_", " "): slope.p for name, slope in slopes.items()}
    p |= {
        "gap": 1.0 if gaps is None or gaps.p is None else gaps.p,
        "collisions": cells.p if cells else 1.0,
    }
    return {question: value < ALPHA for question, value in p.items()}


@dataclass(frozen=True, slots=True)
class Case:
    """An arm of this truth and size: by itself, or beside ``other``, an arm or the humans."""

    own: Truth
    repetitions: int
    against: str = ""
    other: Truth | None = None
    other_repetitions: int = 0

    @property
    def effects(self) -> dict[str, float]:
        """By question the effect that there is to find; that of I4 is to be small."""
        sizes = {
            question: getattr(self.own, number)
            - (getattr(self.other, number) if self.other else 0.0)
            for question, (_, number, _) in QUESTIONS.items()
            if (question in TESTED) is (self.other is None)
        }
        known = {*QUESTIONS} - {"gap"} if self.against == HUMANS else {*QUESTIONS}
        return {question: size for question, size in sizes.items() if size and question in known}

    def chances(
        self, conditions: Sequence[str], multiple: float, simulations: int
    ) -> dict[str, float]:
        """By question the share of simulated studies, of so many times this size, that find it."""
        rng, found = np.random.default_rng(SEED), Counter[str]()
        effects = self.effects
        for _ in range(simulations if effects else 0):
            own = simulate(self.own, conditions, round(multiple * self.repetitions), rng)
            other, size = None, round(multiple * self.other_repetitions)
            if self.other:
                other = simulate(self.other, conditions, size, rng) if size else human_trials()
            found.update(findings(own, other))
        return {question: found[question] / simulations for question in effects}


def chances(
    plan: Plan, cost_usd: float | None, groups: Sequence[Group], simulations: int
) -> Iterator[Row]:
    """Simulate a plan that costs so much; ``groups`` are played ones. Raises UsageError."""
    arms: dict[Case, list[str]] = {}  # equal arms share rows
    for label, case in _cases(plan, groups):
        arms.setdefault(case, []).append(label)
    for case, labels in arms.items():
        trials = case.repetitions * len(plan.conditions)
        at = {m: case.chances(plan.conditions, m, simulations) for m in MULTIPLES}
        for question, effect in case.effects.items():
            table, _, unit = QUESTIONS[question]
            if case.against == HUMANS:
                table = VERDICTS
            enough = next((m for m in MULTIPLES if at[m][question] >= POWER), None)
            key = [table, question, ", ".join(labels), case.against, case.own.name]
            shares: list[Value] = [100 * at[m][question] for m in MULTIPLES]
            size = None if enough is None else round(enough * trials)
            cost = None if enough is None or cost_usd is None else enough * cost_usd
            values = [*key, unit, effect, trials, *shares, size, cost]
            yield Row("/".join(key), (), dict(zip([c.name for c in COLUMNS], values, strict=True)))


def power_table(title: str, rows: Sequence[Row]) -> Table:
    """Return the rows of ``chances`` as a table."""
    notes = (
        f"n: trials of an arm; {', '.join(f'x{m:g}' for m in MULTIPLES)}: the share of simulated "
        "studies with so many times the repetitions that find the effect at p < .05 (I1 to I4: by "
        "the robust tests; rates by Fisher's exact test within conditions, means by Welch's, as in "
        "the tables), before any correction for several comparisons; n for 80 %, USD: the smallest "
        "of these sizes with this power",
        "truth: published humans, the driver as it was played, or what is planted in the emulator, "
        "with the [effect] that the study names; without one, an arm leaves 1 m more than the "
        "first, and collides twice as often",
    )
    return Table("power", COLUMNS, rows, notes, title=title)


def _cases(plan: Plan, groups: Sequence[Group]) -> Iterator[tuple[str, Case]]:
    arms = [(arm, _truths(plan, arm, groups)) for arm in plan.arms]
    for arm, truths in arms:
        for own in truths:
            yield arm.label, Case(own, arm.repetitions)
            yield arm.label, Case(own, arm.repetitions, HUMANS, human())
    (first, others), *rest = arms
    for arm, truths in rest:
        for own, other in zip(truths, others, strict=False):
            more = own
            if own == other == human():  # nothing is named
                more = own.plus(Effect(gap_m=1.0, collided=own.collided))
            yield arm.label, Case(more, arm.repetitions, first.label, other, first.repetitions)


def _truths(plan: Plan, arm: Arm, groups: Sequence[Group]) -> list[Truth]:
    """As planted in the emulator on both sides; or as humans and as played, with named effects."""
    entries = [arm.entries.get(name) for name in arm.asked.values()]
    fields = [planted_fields(entry.parameters) if entry else {} for entry in entries]
    if all(fields) and fields[0] == fields[1]:
        planted = validated(PlantedEffect, fields[0], "what is planted")
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
            truths = [truth.plus(added) for truth in truths]
    return truths
