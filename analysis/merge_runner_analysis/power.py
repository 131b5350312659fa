"""The chances of a study to find effects: simulated trials, judged by the tests of the tables."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache, lru_cache, partial
from typing import NamedTuple

import numpy as np
import pandas as pd
from scipy import optimize, stats
from scipy.special import expit

from merge_runner.config import validated
from merge_runner.drivers.registry import EMULATOR
from merge_runner.planted_effect import PlantedEffect, planted_fields
from merge_runner.prompts.blocks import BASELINE, composed, decomposed
from merge_runner.records import Side
from merge_runner.registry import require
from merge_runner.run.estimate import typical_prompt
from merge_runner.run.plan import Plan
from merge_runner.run.summary import UNREAD_WORDS
from merge_runner.scenarios.merge.conditions import CONDITIONS
from merge_runner.study.arms import MODEL, PROMPT, Arm
from merge_runner.study.file import Effect, PlantedWords
from merge_runner_analysis.grouping import Group
from merge_runner_analysis.published import HUMAN_GAP_SD_M, human_outcomes, published
from merge_runner_analysis.stats import regressions
from merge_runner_analysis.stats.contrasts import contrast_means, contrast_rates, shared_cells
from merge_runner_analysis.stats.indicators import TESTED, fits, judge
from merge_runner_analysis.stats.intervals import POWER
from merge_runner_analysis.stats.regressions import Array
from merge_runner_analysis.stats.sides import read_twice
from merge_runner_analysis.tables.model import Column, Row, Table, Value
from merge_runner_analysis.wording import ALPHA, joined

COEFFICIENTS = 7  # of a truth: of who merges first, and of the gap
MULTIPLES = (0.5, 1.0, 2.0, 4.0)
SEED = 260409609
NORMAL = stats.norm.ppf((np.arange(99) + 0.5) / 99)  # evenly likely draws
HUMANS = "humans"
PLANTED, PLAYED, NAMED, DEFAULTS = "as planted", "as played", "[effect]", "default"
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
# By the name of a primary measure in a study's file.
PRIMARY_ENDPOINTS = {
    "goes_first": "goes first",
    "collided": "collisions",
    "gap_m": "gap",
    "left_first_percent": "goes first",
    "collided_percent": "collisions",
    "collided_boxes_percent": "collisions",
}
NEGLIGIBLE = 1e-6  # an effect that is no more than this is none
MIRRORED = " mirrored"  # after the name of a condition: as the driver on the right sees it
COLUMNS = (
    Column("table", "table", noted=True),
    Column("question", "question"),
    Column("arms", "level"),
    Column("against", "against", optional=True),
    Column("truth", "truth"),
    Column("assumed", "assumed by"),
    Column("effect", "effect", "number"),
    Column("unit", "unit"),
    Column("trials", "n", "count"),
    *(Column(f"times_{m:g}", f"x{m:g}", "percent", digits=0) for m in MULTIPLES),
    Column("enough", "n for 80 %", "count", optional=True),
    Column("cost_usd", "USD", "number", optional=True),
)


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
        trials = _trials_of(self, conditions)
        return _chance(trials["logit"], trials["noise"])

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


def _chance(logits: pd.Series, noise: pd.Series) -> Array:
    """Return the mean chance of each trial over the noise of its logit."""
    every = logits.to_numpy()[:, None] + noise.to_numpy()[:, None] * NORMAL
    return np.asarray(expit(every).mean(axis=1))


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
    if len(b) < COEFFICIENTS:
        return None
    design, gap_m, _ = regressions.gap_data(group.trials)
    scatter = np.linalg.norm(gap_m - design @ b[3:]) / fits(group).ols.freedom ** 0.5
    collided = group.ended["status"].eq("collided").mean()
    return Truth(f"{group.id} as played", float(scatter), float(collided), 0.0, *b)


def _trials_of(truth: Truth, conditions: Sequence[str], repetitions: int = 1) -> pd.DataFrame:
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


def _drawn(trials: pd.DataFrame, rng: np.random.Generator) -> pd.DataFrame:
    n = len(trials)
    collided = rng.random(n) < trials["collided"]
    first = rng.random(n) < expit(trials["logit"] + trials["noise"] * rng.standard_normal(n))
    gap_m = trials["gap_m"] + trials["gap_sd_m"] * rng.standard_normal(n)
    left_first = first.astype(float).mask(collided)
    return trials.assign(collided=collided, left_first=left_first, gap_m=gap_m.mask(collided))


def simulate(
    truth: Truth, conditions: Sequence[str], repetitions: int, rng: np.random.Generator
) -> pd.DataFrame:
    """Return ``repetitions`` trials of each condition, with the columns of ``load_trials``."""
    trials = _drawn(_trials_of(truth, conditions, repetitions), rng)
    return trials.assign(
        status=np.where(trials["collided"], "collided", "finished"),
        merged_first=np.where(trials["left_first"] == 1, "left", "right"),
    )


def significant(trials: pd.DataFrame, other: pd.DataFrame | None) -> dict[str, bool]:
    """Return by question whether a driver's trials show it at p < .05, alone or against humans."""
    if other is None:
        gap = regressions.gap_ols(trials, robust=True)
        judged = judge(regressions.who_first_firth(trials), gap, robust=True)
        return {name: judgement.passed is True for name, judgement in judged.items()}
    slopes = regressions.who_first_firth(trials, less=other).terms
    cells = shared_cells(trials, other, "collided")
    p = {name.replace("_", " "): slope.p for name, slope in slopes.items()}
    p["collisions"] = cells.p if cells else 1.0
    return {question: value < ALPHA for question, value in p.items()}


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
        """Return by question whether one simulated study shows it, at a multiple of the size."""
        trials = simulate(self.driver, self.conditions, round(multiple * self.repetitions), rng)
        return significant(trials, human_sample() if self.against else None)


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
        trials = _trials_of(self.truth, self.conditions, round(multiple * self.repetitions))
        names, images = trials["condition"], pd.Series(None, trials.index, dtype=object)
        if sides and self.equal:
            images = names.map(partial(_image, conditions=self.conditions)) + f" right{self.cell}"
        of_side = f" {self.side}" if sides else ""
        return trials.assign(condition=names + of_side + self.cell, image=images)


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
            expected = trials.assign(left_first=_chance(trials["logit"], trials["noise"]))
            means.append(_by_cell(expected, column).groupby("condition")["value"])
        (level, n), (reference, m) = ((values.mean(), values.size()) for values in means)
        weights = (n * m / (n + m)).dropna()
        unit = 1 if self.measure == "gap" else 100
        return unit * float((level - reference).dropna() @ weights / weights.sum())

    def effects(self) -> dict[str, Assumed]:
        """Return the assumed effect."""
        unit = ENDPOINTS[self.measure].unit
        return {self.measure: Assumed(EFFECTS, self.size, unit, self.assumed)}

    def detected(self, multiple: float, rng: np.random.Generator) -> dict[str, bool]:
        """Return whether one simulated study, ``multiple`` times this size, shows a difference."""
        column = ENDPOINTS[self.measure].column
        level, reference = (
            _by_cell(_drawn(trials, rng), column) for trials in self._levels(multiple)
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


def power(case: Case | Contrast, multiple: float, simulations: int) -> dict[str, float]:
    """Return by question the share of simulated studies that find it, at a multiple of the size."""
    rng, counts = np.random.default_rng(SEED), Counter[str]()
    for _ in range(simulations):
        counts.update(name for name, shown in case.detected(multiple, rng).items() if shown)
    return {question: counts[question] / simulations for question in case.effects()}


def chances(
    plan: Plan,
    cost_usd: float | None,
    groups: Sequence[Group],
    simulations: int,
    say_now: Callable[[str], object] = str,
) -> Iterator[Row]:
    """Simulate a plan with this cost; ``groups`` are played ones. Raises UsageError.

    Each level but a reference has a row in the primary measure. Drivers have rows without a
    reference if no factor varies, or if levels change their response to the situation. ``say_now``
    gets a line of progress before each simulation.
    """
    labels: dict[Case | Contrast, list[tuple[str, str]]] = {}  # equal ones share rows
    for label, against, case in _cases(plan, groups):
        labels.setdefault(case, []).append((label, against))
    for number, (case, names) in enumerate(labels.items(), 1):
        say_now(f"simulating {number} of {len(labels)}: {names[0][0]}")
        at = {m: power(case, m, simulations) for m in MULTIPLES}
        levels, against = (", ".join(dict.fromkeys(column)) for column in zip(*names, strict=True))
        for question, (table, effect, unit, by) in case.effects().items():
            enough = next((m for m in MULTIPLES if at[m][question] >= POWER), None)
            key = [table, question, levels, against, case.truth]
            size = None if enough is None else round(enough * case.trials)
            cost = None if enough is None or cost_usd is None else enough * cost_usd
            shares: list[Value] = [100 * at[m][question] for m in MULTIPLES]
            values = [*key, by, effect, unit, case.trials, *shares, size, cost]
            yield Row("/".join(key), (), dict(zip([c.name for c in COLUMNS], values, strict=True)))


def unread_words(plan: Plan) -> str:
    """Say which levels of texts change no trial of the emulator; empty without one."""
    words = dict.fromkeys(
        word
        for arm in plan.arms
        for entry in arm.entries.values()
        if entry.provider == EMULATOR and "x_persona" not in entry.parameters
        for word in decomposed(arm.variant)[1]
    )
    unread = [word for word in words if _planted_words(plan, word) == PlantedWords()]
    if not unread:
        return ""
    return f"{joined(unread)}: the power is that of a model which reads the words. {UNREAD_WORDS}"


def _planted_words(plan: Plan, word: str) -> PlantedWords:
    factor, _, level = word.partition("=")
    return plan.study.file.texts[factor][level].emulator


def power_table(title: str, rows: Sequence[Row], note: str = "") -> Table:
    """Return the rows of ``chances`` as a table, with a note of its own before the others."""
    times = ", ".join(f"x{m:g}" for m in MULTIPLES)
    notes = (
        *filter(None, [note]),
        f"n: trials of the level or driver; {times}: the share of simulated studies with so many "
        "times the repetitions that find the effect at p < .05, by the test of its table (effects; "
        "I1 to I4: indicators; humans: verdicts), before any correction; n for 80 %, USD: the "
        "smallest of these sizes with this power",
        "truth: published humans, the driver as it was played, or what a rehearsal of the emulator "
        "plants",
        f"assumed by: {NAMED} of the study, or {PLAYED}; by {DEFAULTS}, where neither says "
        "anything of the measure, a level goes first in 15 points more, leaves 1 m more, or "
        "collides twice as often. What words plant in the emulator is never assumed",
        "effects: a row for each level in the study's primary measure; nothing is assumed of "
        "interactions. n counts all trials; the table effects pools sample sets, and counts once "
        "the trials of a mock model that differ in words that it does not read",
    )
    return Table("power", COLUMNS, rows, notes, title=title)


def _cases(plan: Plan, groups: Sequence[Group]) -> Iterator[tuple[str, str, Case | Contrast]]:
    truths = {arm.label: _truths(plan, arm, groups) for arm in plan.arms}
    contrasts = list(_contrasts(plan, truths))
    yield from contrasts
    drivers: dict[frozenset[tuple[str, str]], tuple[Arm, int]] = {}
    for arm in plan.arms:  # tables pool the counterbalanced positions of a pair
        first, repetitions = drivers.get(key := frozenset(_levels(arm).items()), (arm, 0))
        drivers[key] = first, repetitions + arm.repetitions
    every = [(arm.label, truth, n) for arm, n in drivers.values() for truth in truths[arm.label]]
    slopes = {(truth.projected_headway, truth.relative_velocity) for _, truth, _ in every}
    if contrasts and len(slopes) < 2:
        return
    for label, truth, repetitions in every:
        for against in ("", HUMANS):
            yield label, against, Case(truth, tuple(plan.conditions), repetitions, against)


def _contrasts(
    plan: Plan, truths: Mapping[str, list[Truth]]
) -> Iterator[tuple[str, str, Contrast]]:
    """Yield each level against its factor's reference, as the table of effects does."""
    for scripted in (False, True):
        arms = [arm for arm in plan.arms if arm.is_scripted is scripted]
        at: dict[frozenset[tuple[str, str]], list[Arm]] = {}
        for arm in arms:
            at.setdefault(frozenset(_levels(arm).items()), []).append(arm)
        for factor in dict.fromkeys(name for arm in arms for name in _levels(arm)):
            named = dict.fromkeys(_levels(a)[factor] for a in arms if factor in _levels(a))
            reference, *others = sorted(named, key=partial(_place, plan, factor))
            for level in others:
                pairs = []
                for key, level_arms in at.items():
                    cell = key - {(factor, level)}
                    twins = at.get(cell | {(factor, reference)}, [])
                    reads = factor != PROMPT or level_arms[0].entries
                    if (factor, level) in key and twins and reads:
                        name = "".join(f" {n}={x}" for n, x in sorted(cell))
                        pairs.append((name, level_arms, twins))
                for contrast in _assumed(plan, truths, factor, pairs):
                    yield f"{factor}={level}", f"{factor}={reference}", contrast


def _assumed(
    plan: Plan,
    truths: Mapping[str, list[Truth]],
    factor: str,
    pairs: Sequence[tuple[str, list[Arm], list[Arm]]],
) -> Iterator[Contrast]:
    """Yield a contrast of these cells and arms for each assumed behaviour."""
    one_sided = any(arm.focal and not arm.is_mixed for arm in plan.arms)
    levels = [[(cell, arm) for cell, *both in pairs for arm in both[place]] for place in range(2)]
    ways = min((len(truths[arm.label]) for level in levels for _, arm in level), default=0)
    for way in range(ways):
        of_level, of_reference = (
            tuple(_played(plan, arm, cell, truths[arm.label][way]) for cell, arm in level)
            for level in levels
        )
        yield _with_assumption(
            plan, factor, Contrast(of_level, of_reference, _primary(plan), PLAYED, one_sided)
        )


def _with_assumption(plan: Plan, factor: str, contrast: Contrast) -> Contrast:
    """Return a contrast with the source of its effect, or else with the default effect."""
    effect = plan.study.file.effect.get(factor, Effect())
    if contrast.truth == PLANTED:
        return replace(contrast, assumed=PLANTED)
    if any(getattr(effect, name) for name in ENDPOINTS[contrast.measure].changed_by):
        return replace(contrast, assumed=NAMED)
    if contrast.truth != human().name and abs(contrast.size) > NEGLIGIBLE:
        return contrast
    parts = tuple(
        replace(part, truth=part.truth.plus(_by_default(contrast.measure, part), part.conditions))
        for part in contrast.level
    )
    return replace(contrast, assumed=DEFAULTS, level=parts)


def _by_default(measure: str, level: Played) -> Effect:
    if measure == "collisions":
        return Effect(collided=min(level.truth.collided, 1 - level.truth.collided))
    return Effect(goes_first=0.15) if measure == "goes first" else Effect(gap_m=1.0)


def _played(plan: Plan, arm: Arm, cell: str, truth: Truth) -> Played:
    turned = arm.ego == "right"
    names = [_image(name, plan.conditions) if turned else name for name in plan.conditions]
    equal = not arm.is_mixed and arm.focal is None
    return Played(cell, arm.ego, equal, tuple(names), arm.repetitions, truth)


def _image(condition: str, conditions: Sequence[str]) -> str:
    """Return a condition as the driver on the right sees it, named as one of these if it can be."""
    if condition.endswith(MIRRORED):
        return condition.removesuffix(MIRRORED)
    driven = CONDITIONS[condition]
    mirrored = (-driven.projected_headway_m, -driven.relative_velocity_mps)
    for name in conditions:
        known = CONDITIONS.get(name)
        if known and (known.projected_headway_m, known.relative_velocity_mps) == mirrored:
            return name
    return condition + MIRRORED


def _levels(arm: Arm) -> dict[str, str]:
    return {MODEL: arm.model_level, PROMPT: arm.variant, **arm.factors}


def _primary(plan: Plan) -> str:
    """Return the study's primary measure, as ENDPOINTS name it; raises UsageError."""
    name = plan.study.file.primary
    return require(PRIMARY_ENDPOINTS, "measure to simulate:", name, "by primary in the study")


def _place(plan: Plan, factor: str, level: str) -> int:
    listed = plan.levels.get(factor, [])
    return listed.index(level) if level in listed else len(listed)


def _rehearses(plan: Plan) -> bool:
    """Return whether the emulator's parameters plant effects, and no text and no [effect] does."""
    file = plan.study.file
    words = (word for levels in file.texts.values() for word in levels.values())
    if file.effect or any(word.emulator != PlantedWords() for word in words):
        return False
    return any(planted_fields(entry.parameters) for entry in plan.entries.values())


def _truths(plan: Plan, arm: Arm, groups: Sequence[Group]) -> list[Truth]:
    """Return an arm's assumed behaviours: humans and as played, with [effect], or as planted."""
    ego = arm.entries.get(arm.names[0])
    if ego and _rehearses(plan):
        fields = planted_fields(ego.parameters)
        planted = validated(PlantedEffect, fields, "what is planted")
        planted = planted.before(typical_prompt(plan, arm))
        if arm.ego == "right":
            planted = planted.model_copy(update={"x_left_first": -planted.x_left_first})
        # The script aims at gaps from 1.8 to 6.5 m; in 1 of 33 trials two vehicles collide.
        gap = (4.15 + planted.x_gap_m, 0.0, 0.0, 0.0)
        return [Truth(PLANTED, 1.36, 1 / 33, planted.x_noise, *planted.coefficients, *gap)]
    effects = plan.study.file.effect
    prompt, words = decomposed(arm.variant)
    unnamed = [word for word in words if word.partition("=")[0] not in effects]
    setting = composed(BASELINE if PROMPT in effects else prompt, unnamed)
    by_setting = {(g.name, g.setting): g for g in reversed(groups) if not g.scripted}
    known = [by_setting[arm.model, p] for p in (setting, BASELINE) if (arm.model, p) in by_setting]
    people = human()
    if len({other.ego for other in plan.arms}) > 1:
        people = replace(people, intercept=0.0)  # both sides are one driver's: none is favoured
    truths = [people, *filter(None, map(played, known[:1]))]
    conditions = _played(plan, arm, "", people).conditions
    for factor, effect in effects.items():
        level = _levels(arm).get(factor)
        if level not in (None, plan.levels[factor][0]):
            truths = [truth.plus(effect, conditions) for truth in truths]
    return truths
