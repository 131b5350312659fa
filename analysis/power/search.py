"""The chance to find an effect, the smallest one that is found, and the trials that it takes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

from analysis.power.questions import Question
from analysis.power.samples import Conditions, Sample, human_sample, simulate
from analysis.power.truths import Truth, human
from analysis.stats.ceiling import SEED
from analysis.stats.intervals import POWER

MOST = 4
"""So many times the study's repetitions are looked at."""
HALVINGS = 7
# Which random numbers: those of an arm, and those of the arm that it is compared with.
OWN, OTHER = 0, 1


@dataclass(frozen=True, slots=True)
class Arms:
    """An arm as it is supposed to go, and what it is compared with: an arm, or the humans.

    ``other_repetitions`` is None for the humans, whose trials are there, and if there is no other.
    """

    truth: Truth
    repetitions: int
    other: Truth | None = None
    other_repetitions: int | None = None

    def times(self, repetitions: int) -> tuple[int, int]:
        """The repetitions of both where the arm has so many, in the same proportion."""
        other = self.other_repetitions or 0
        return repetitions, max(1, round(other * repetitions / self.repetitions))


@dataclass(frozen=True)
class Search:
    """Simulates ``sets`` data sets of each size and truth; equal seeds give equal chances."""

    conditions: Conditions
    sets: int
    seed: int
    _samples: dict[tuple[Truth, int, int], Sample] = field(default_factory=dict)

    def chance(self, question: Question, arms: Arms, repetitions: int) -> float:
        """The share of data sets in which the effect is found, with so many repetitions."""
        own, others = arms.times(repetitions)
        sample = self._sample(arms.truth, own, OWN)
        if arms.other is None:
            other = None
        elif arms.other_repetitions is None:
            other = human_sample(self.sets)
        else:
            other = self._sample(arms.other, others, OTHER)
        return float(question.found(sample, other).mean())

    def fewest_repetitions(self, question: Question, arms: Arms) -> int | None:
        """From how many repetitions on the power is reached; None where MOST times are too few."""
        most = MOST * arms.repetitions
        return _first(lambda n: self.chance(question, arms, n) >= POWER, most)

    def smallest(self, question: Question, arms: Arms) -> float | None:
        """The smallest effect, or difference from the other, that is found with the power."""
        effect = question.effect
        if effect is None:
            return None
        none = 0.0 if arms.other is None else effect.of(arms.other)

        def found(part: float) -> bool:
            changed = effect.put(arms.truth, none + part * effect.furthest)
            own = Arms(changed, arms.repetitions, arms.other, arms.other_repetitions)
            return self.chance(question, own, arms.repetitions) >= POWER

        steps = 2**HALVINGS
        step = _first(lambda n: found(n / steps), steps)
        return None if step is None else step / steps * effect.furthest

    def _sample(self, truth: Truth, repetitions: int, stream: int) -> Sample:
        key = truth, repetitions, stream
        if key not in self._samples:
            seed = SEED, self.seed, stream
            self._samples[key] = simulate(truth, self.conditions, repetitions, self.sets, seed)
        return self._samples[key]


def difference(question: Question, arms: Arms) -> float | None:
    """The effect that there is to find, None where none can be named."""
    if question.effect is None:
        return None
    none = 0.0 if arms.other is None else question.effect.of(arms.other)
    return question.effect.of(arms.truth) - none


def beside_humans(truth: Truth, repetitions: int) -> Arms:
    """An arm and the human trials."""
    return Arms(truth, repetitions, human())


def _first(holds: Callable[[int], bool], most: int) -> int | None:
    """The first of 1 ... ``most`` from which on something holds, None where it does not there."""
    if not holds(most):
        return None
    low, high = 0, most
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (low, middle) if holds(middle) else (middle, high)
    return high
