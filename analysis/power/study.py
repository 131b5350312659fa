"""What a study can find: for its arms, at its size and around it, and what that costs."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cache, partial

import numpy as np
from scipy import stats

from merge_runner.config import validated
from merge_runner.planted_effect import PlantedEffect, planted_fields
from merge_runner.run.estimate import Estimate, typical_prompt
from merge_runner.run.plan import Plan
from merge_runner.scenarios.merge.conditions import CONDITIONS
from merge_runner.study.crossing import Arm
from merge_runner_analysis.data.study import Group
from merge_runner_analysis.names import BASELINE
from merge_runner_analysis.power.truths import (
    SPEED,
    Conditions,
    Sample,
    Truth,
    human,
    human_sample,
    planted,
    played,
    simulate,
)
from merge_runner_analysis.stats.indicators import ALPHA, GAP_MARGIN_M, ROBUST
from merge_runner_analysis.stats.intervals import POWER
from merge_runner_analysis.stats.many_fits import Holds, firth_differences, mean_gap_differences
from merge_runner_analysis.stats.regressions import WHO_FIRST_TERMS

MULTIPLES = (0.5, 1.0, 2.0)
MOST = 4  # so many times the study's repetitions are looked at
STEPS = 128  # in which the smallest effect is looked for
OWN, OTHER = 0, 1  # streams of random numbers: of an arm, and of the one it is compared with


@dataclass(frozen=True, slots=True)
class Test:
    """A test of a table: in which data sets of an arm, perhaps beside others, it finds an effect.

    The effect is the number ``at`` of the ``field`` of a truth, or its difference from that of the
    other arm, in ``unit``; without a field there is none to vary. ``furthest`` is the largest that
    is looked for, of the sign that is looked for. ``supposed`` makes the effect between two arms.
    """

    table: str
    question: str
    found: Callable[[Sample, Sample], Holds]
    field: str = ""
    at: int = 0
    furthest: float = 0.0
    unit: str = ""
    supposed: Callable[[float], float] | None = None

    @property
    def factor(self) -> int:
        """What turns the number into its unit."""
        return 100 if self.unit == "%" else 1

    def of(self, truth: Truth | None) -> float:
        """The number of a truth; 0 of none."""
        return 0.0 if truth is None else float(getattr(truth, self.field)[self.at])


def _indicator(name: str, sample: Sample, _: Sample) -> Holds:
    criterion = ROBUST[name]
    return (sample.firth if criterion.of_who_first else sample.gap).passes(criterion)


def _all_hold(sample: Sample, other: Sample) -> Holds:
    return np.asarray(np.logical_and.reduce([_indicator(name, sample, other) for name in ROBUST]))


def _speed_differs(sample: Sample, other: Sample) -> Holds:
    fit = firth_differences(sample.draws, other.draws, WHO_FIRST_TERMS[SPEED])
    return fit.sound & (fit.p[:, SPEED] < ALPHA)


def _gap_differs(sample: Sample, other: Sample) -> Holds:
    return mean_gap_differences(sample.draws, other.draws)[1] < ALPHA


def _collisions_differ(sample: Sample, other: Sample) -> Holds:
    pairs = zip(sample.collided.tolist(), other.collided.tolist(), strict=True)
    return np.array([_fisher_p(a, sample.trials, b, other.trials) < ALPHA for a, b in pairs])


@cache
def _fisher_p(a: int, n: int, b: int, m: int) -> float:
    return float(stats.fisher_exact([[a, n - a], [b, m - b]]).pvalue)


OF_AN_ARM = (
    Test(
        "who-first",
        "projected headway (I1)",
        partial(_indicator, "I1"),
        "who_first",
        1,
        5.0,
        "per m",
    ),
    Test(
        "who-first",
        "relative velocity (I2)",
        partial(_indicator, "I2"),
        "who_first",
        SPEED,
        -8.0,
        "per m/s",
    ),
    Test("gap", "|projected headway| (I3)", partial(_indicator, "I3"), "gap", 1, 2.0, "m per m"),
    Test("gap", "effect of relative velocity small (I4)", partial(_indicator, "I4")),
    Test("indicators", "I1 to I4 all hold", _all_hold),
)
COLLISIONS = Test("contrasts", "collisions", _collisions_differ, "collided", 0, 0.6, "%")
BESIDE_HUMANS = (
    Test("differences", "relative velocity", _speed_differs, "who_first", SPEED, 8.0, "per m/s"),
    COLLISIONS,
)
OF_TWO_ARMS = (
    Test(
        "contrasts", "gap", _gap_differs, "gap", 0, 5.0, "m", lambda metres: metres + GAP_MARGIN_M
    ),
    replace(COLLISIONS, supposed=lambda share: 2 * share),
)


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
class Case:
    """A test of an arm that goes as ``own``, beside ``other``: another arm, or the humans.

    ``other_repetitions`` is 0 for the humans, whose trials are there, and if there is no other.
    """

    test: Test
    against: str
    truth: str
    own: Truth
    repetitions: int
    other: Truth | None = None
    other_repetitions: int = 0

    @property
    def effect(self) -> float | None:
        """What there is to find, None where it is no number."""
        return self.test.of(self.own) - self.test.of(self.other) if self.test.field else None


@dataclass(frozen=True, slots=True)
class Search:
    """Simulates ``sets`` data sets of each size and truth; equal seeds give equal chances."""

    conditions: Conditions
    sets: int
    seed: int

    def chance(self, case: Case, repetitions: int) -> float:
        """The share of data sets in which the effect is found; other arms grow alike."""
        own = simulate(case.own, self.conditions, repetitions, self.sets, (self.seed, OWN))
        other = human_sample(self.sets)
        if case.other is not None and case.other_repetitions:
            n = max(1, round(case.other_repetitions * repetitions / case.repetitions))
            other = simulate(case.other, self.conditions, n, self.sets, (self.seed, OTHER))
        return float(case.test.found(own, other).mean())

    def fewest_repetitions(self, case: Case) -> int | None:
        """From how many repetitions on the power is reached; None where MOST times are too few."""
        return _first(lambda n: self.chance(case, n) >= POWER, MOST * case.repetitions)

    def smallest(self, case: Case) -> float | None:
        """The smallest effect that is found with the power."""
        test, none = case.test, case.test.of(case.other) if case.test.field else 0.0

        def found(step: int) -> bool:
            value = none + step / STEPS * test.furthest
            own = case.own.changed(test.field, test.at, value)
            return self.chance(replace(case, own=own), case.repetitions) >= POWER

        step = _first(found, STEPS) if test.field else None
        return None if step is None else step / STEPS * test.furthest


def chances(
    plan: Plan, expected: Estimate, groups: Sequence[Group], *, simulations: int, seed: int
) -> list[Chance]:
    """Simulate a plan; ``groups`` are played ones, ``expected`` is what it takes.

    Raises UsageError.
    """
    drawn = [CONDITIONS[name] for name in plan.conditions]
    conditions = Conditions(
        tuple(each.projected_headway_m for each in drawn),
        tuple(each.relative_velocity_mps for each in drawn),
    )
    search = Search(conditions, simulations, seed)
    arms: dict[Case, list[str]] = {}  # equal arms share a row
    for label, case in _cases(plan, groups):
        arms.setdefault(case, []).append(label)
    found = []
    tests = (*OF_AN_ARM, *BESIDE_HUMANS, *OF_TWO_ARMS)
    for case, labels in sorted(arms.items(), key=lambda item: tests.index(item[0].test)):
        test, repetitions = case.test, case.repetitions
        enough = None if case.effect == 0 else search.fewest_repetitions(case)
        sizes = [max(1, round(multiple * repetitions)) for multiple in MULTIPLES]
        found.append(
            Chance(
                arms=tuple(labels),
                against=case.against,
                table=test.table,
                question=test.question,
                truth=case.truth,
                effect=times(case.effect, test.factor),
                unit=test.unit,
                trials=repetitions * len(drawn),
                found=tuple(search.chance(case, size) for size in sizes),
                smallest=times(search.smallest(case), test.factor),
                enough=None if enough is None else enough * len(drawn),
                cost_usd=times(expected.cost_usd, None if enough is None else enough / repetitions),
            )
        )
    return found


def times(value: float | None, factor: float | None) -> float | None:
    """A product, None where a factor is unknown."""
    return None if value is None or factor is None else value * factor


def _cases(plan: Plan, groups: Sequence[Group]) -> Iterator[tuple[str, Case]]:
    first, *others = plan.arms
    truths = {arm.label: _truths(plan, arm, groups) for arm in plan.arms}
    for arm in plan.arms:
        for truth in truths[arm.label]:
            for test in OF_AN_ARM:
                yield arm.label, Case(test, "", truth.name, truth, arm.repetitions)
            for test in BESIDE_HUMANS:
                yield arm.label, Case(test, "humans", truth.name, truth, arm.repetitions, human())
    for arm in others:
        for own, other in zip(truths[arm.label], truths[first.label], strict=False):
            for test in OF_TWO_ARMS:
                gone = own
                if own.name == other.name == "human":
                    assert test.supposed is not None
                    gone = own.changed(test.field, test.at, test.supposed(test.of(own)))
                sizes = arm.repetitions, other, first.repetitions
                case = Case(test, first.label, other.name, gone, *sizes)
                if case.effect:
                    yield arm.label, case


def _truths(plan: Plan, arm: Arm, groups: Sequence[Group]) -> list[Truth]:
    """How an arm may go: as planted in the emulator on both sides, or as humans and as played."""
    fields = [
        planted_fields(arm.entries[name].parameters) if name in arm.entries else {}
        for name in arm.asked.values()
    ]
    if all(fields) and fields[0] == fields[1]:
        effect = validated(PlantedEffect, fields[0], "what is planted")
        return [planted(effect.before(typical_prompt(plan, arm)))]
    known = [
        group
        for variant in dict.fromkeys((arm.variant, BASELINE))
        for group in groups
        if (group.name, group.setting) == (arm.model, variant)
    ]
    return [human(), *filter(None, [played(group) for group in known[:1]])]


def _first(holds: Callable[[int], bool], most: int) -> int | None:
    """The first of 1 ... ``most`` from which on something holds, None where it does not there."""
    if not holds(most):
        return None
    low, high = 0, most
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (low, middle) if holds(middle) else (middle, high)
    return high
