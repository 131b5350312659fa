"""The simulated tests of a plan: each level against its reference, and each driver."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial

from merge_runner.config import validated
from merge_runner.planted_effect import PlantedEffect, planted_fields
from merge_runner.prompts.blocks import BASELINE, composed, decomposed
from merge_runner.registry import require
from merge_runner.run.estimate import typical_prompt
from merge_runner.run.plan import Plan
from merge_runner.study.arms import MODEL, PROMPT, Arm
from merge_runner.study.file import Effect, PlantedWords
from merge_runner_analysis.grouping import Group
from merge_runner_analysis.power.cases import ENDPOINTS, Case, Contrast, Played
from merge_runner_analysis.power.truth import Truth, human, image, played

HUMANS = "humans"
PLANTED, PLAYED, NAMED, DEFAULTS = "as planted", "as played", "[effect]", "default"
NEGLIGIBLE = 1e-6  # an effect that is no more than this is none
# By the name of a primary measure in a study's file.
PRIMARY = {
    "goes_first": "goes first",
    "collided": "collisions",
    "gap_m": "gap",
    "left_first_percent": "goes first",
    "collided_percent": "collisions",
    "collided_boxes_percent": "collisions",
}


def cases(plan: Plan, groups: Sequence[Group]) -> Iterator[tuple[str, str, Case | Contrast]]:
    """Yield tests with the names of level and reference; ``groups`` are played ones."""
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
        name = plan.study.file.primary
        measure = require(PRIMARY, "measure to simulate:", name, "by primary in the study")
        contrast = Contrast(of_level, of_reference, measure, PLAYED, one_sided)
        yield _with_assumption(plan, factor, contrast)


def _with_assumption(plan: Plan, factor: str, contrast: Contrast) -> Contrast:
    """Return a contrast with the source of its effect, or else with the default effect."""
    effect = plan.study.file.effect.get(factor, Effect())
    if contrast.truth == PLANTED:
        return replace(contrast, assumed=PLANTED)
    if any(getattr(effect, name) for name in ENDPOINTS[contrast.measure].changed_by):
        return replace(contrast, assumed=NAMED)
    if contrast.truth != human().name and abs(contrast.size) > NEGLIGIBLE:
        return contrast
    parts = tuple(part.with_default(contrast.measure) for part in contrast.level)
    return replace(contrast, assumed=DEFAULTS, level=parts)


def _played(plan: Plan, arm: Arm, cell: str, truth: Truth) -> Played:
    turned = arm.ego == "right"
    names = [image(name, plan.conditions) if turned else name for name in plan.conditions]
    equal = not arm.is_mixed and arm.focal is None
    return Played(cell, arm.ego, equal, tuple(names), arm.repetitions, truth)


def _levels(arm: Arm) -> dict[str, str]:
    return {MODEL: arm.model_level, PROMPT: arm.variant, **arm.factors}


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
