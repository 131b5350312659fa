"""What a study can find: for its arms, at its size and around it, and what that costs."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from analysis.power.questions import BESIDE_HUMANS, OF_AN_ARM, OF_TWO_ARMS, Question
from analysis.power.samples import Conditions
from analysis.power.search import Arms, Search, beside_humans, difference
from analysis.power.truths import Truth, planted, supposed
from merge_runner.config import validated
from merge_runner.planted_effect import PlantedEffect, planted_fields
from merge_runner.run.estimate import Estimate, typical_prompt
from merge_runner.run.plan import Plan
from merge_runner.scenarios.merge.conditions import CONDITIONS
from merge_runner.study.crossing import Arm

MULTIPLES = (0.5, 1.0, 2.0)
ORDER = (*OF_AN_ARM, *BESIDE_HUMANS, *OF_TWO_ARMS)


@dataclass(frozen=True, slots=True)
class Chance:
    """How likely one test of one table finds an effect, in the arms ``arms``.

    ``against`` is what they are compared with, empty where nothing is. ``effect`` is what there is
    to find by the ``truth``, None where it is no number. ``trials`` are those of an arm, ``found``
    the chance at each of MULTIPLES. ``smallest`` is the effect that is found with a power of .8 at
    the study's size, ``enough`` the trials of an arm from which on the ``effect`` is, and
    ``cost_usd`` what the whole study costs then; None where there is none, or it is unknown.
    """

    arms: tuple[str, ...]
    against: str
    table: str
    question: str
    truth: str
    effect: float | None
    unit: str
    trials: int
    found: tuple[float, ...]
    smallest: float | None
    enough: int | None
    cost_usd: float | None


@dataclass(frozen=True, slots=True)
class Power:
    """All chances of a study; ``costs_usd`` is its cost at each of MULTIPLES, None: unknown."""

    study: str
    driver: str
    arms: int
    trials: int
    costs_usd: tuple[float | None, ...]
    free: bool
    measured: bool
    simulations: int
    seed: int
    chances: tuple[Chance, ...]


def power(plan: Plan, expected: Estimate, *, simulations: int, seed: int) -> Power:
    """Simulate a plan; ``expected`` is what all of it takes. Raises UsageError."""
    search = Search(_conditions(plan), simulations, seed)
    return Power(
        study=plan.name,
        driver=plan.driver,
        arms=len(plan.arms),
        trials=plan.trials,
        costs_usd=tuple(_times(expected.cost_usd, multiple) for multiple in MULTIPLES),
        free=expected.free,
        measured=bool(expected.measured),
        simulations=simulations,
        seed=seed,
        chances=tuple(
            _chance(search, case, len(plan.conditions), expected.cost_usd) for case in _cases(plan)
        ),
    )


@dataclass(frozen=True, slots=True)
class _Case:
    """A question, the arms that it is asked of, and how these are supposed to go."""

    question: Question
    labels: tuple[str, ...]
    against: str
    truth: str
    arms: Arms


def _cases(plan: Plan) -> Iterator[_Case]:
    """Each question once, whatever the number of arms of which it is the same."""
    found: dict[tuple[object, ...], _Case] = {}
    for case in _every_case(plan):
        key = id(case.question), case.against, case.truth, case.arms
        known = found.get(key)
        labels = (*(known.labels if known else ()), *case.labels)
        found[key] = _Case(case.question, labels, case.against, case.truth, case.arms)
    yield from sorted(found.values(), key=lambda case: ORDER.index(case.question))


def _every_case(plan: Plan) -> Iterator[_Case]:
    first, *others = plan.arms
    truths = {arm.label: _truths(plan, arm) for arm in plan.arms}
    for arm in plan.arms:
        for question in OF_AN_ARM:
            for truth in question.distinct(truths[arm.label]):
                yield _Case(question, (arm.label,), "", truth.name, Arms(truth, arm.repetitions))
        for question in BESIDE_HUMANS:
            for truth in question.distinct(truths[arm.label]):
                arms = beside_humans(truth, arm.repetitions)
                yield _Case(question, (arm.label,), "humans", truth.name, arms)
    for arm in others:
        for question in OF_TWO_ARMS:
            for own, other in _pairs(truths[arm.label], truths[first.label], question):
                arms = Arms(own, arm.repetitions, other, first.repetitions)
                if difference(question, arms):
                    yield _Case(question, (arm.label,), first.label, other.name, arms)


def _pairs(
    own: Sequence[Truth], first: Sequence[Truth], question: Question
) -> Iterator[tuple[Truth, Truth]]:
    """How an arm and the first one are supposed to go.

    Both as they are planted; or, where nothing is, the arm without what the question looks for.
    """
    if len(own) == len(first) == 1:
        yield own[0], first[0]
    elif question.supposed is not None and own == first:
        for truth in question.distinct(first):
            yield question.supposed(truth), truth


def _chance(search: Search, case: _Case, conditions: int, cost_usd: float | None) -> Chance:
    question, arms = case.question, case.arms
    effect = difference(question, arms)
    unit = question.effect.unit if question.effect else ""
    factor = question.effect.factor if question.effect else 1.0
    sizes = [max(1, round(multiple * arms.repetitions)) for multiple in MULTIPLES]
    enough = None if effect == 0 else search.fewest_repetitions(question, arms)
    return Chance(
        arms=case.labels,
        against=case.against,
        table=question.table,
        question=question.asked,
        truth=case.truth,
        effect=_times(effect, factor),
        unit=unit,
        trials=arms.repetitions * conditions,
        found=tuple(search.chance(question, arms, size) for size in sizes),
        smallest=_times(search.smallest(question, arms), factor),
        enough=None if enough is None else enough * conditions,
        cost_usd=None if enough is None else _times(cost_usd, enough / arms.repetitions),
    )


def _times(value: float | None, factor: float) -> float | None:
    return None if value is None else value * factor


def _conditions(plan: Plan) -> Conditions:
    drawn = [CONDITIONS[name] for name in plan.conditions]
    return Conditions(
        tuple(each.projected_headway_m for each in drawn),
        tuple(each.relative_velocity_mps for each in drawn),
    )


def _truths(plan: Plan, arm: Arm) -> tuple[Truth, ...]:
    """How an arm may go: as it is planted in the emulator on both sides, or as is supposed."""
    fields = [
        planted_fields(arm.entries[name].parameters) if name in arm.entries else {}
        for name in arm.asked.values()
    ]
    if not all(fields) or fields[0] != fields[1]:
        return supposed()
    effect = validated(PlantedEffect, fields[0], "what is planted")
    return (planted(effect.before(typical_prompt(plan, arm))),)
