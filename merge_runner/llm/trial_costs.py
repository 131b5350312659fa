"""What a whole trial is expected to cost: the mean of its models' answers, for each usual call.

It decides which trials begin, never what may be spent: each attempt still reserves its own worst
case. Before anything is measured a trial is expected to cost as much as it can.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass

# Trials that turn out longer, and attempts that are charged but bring no answer.
MARGIN = 1.5


@dataclass(frozen=True, slots=True)
class TrialCalls:
    """A model's calls in one trial: how many there usually are, how many at most.

    ``worst_usd`` is the worst case of one of them.
    """

    usual: float
    most: int
    worst_usd: float

    def and_(self, other: TrialCalls) -> TrialCalls:
        """Both together."""
        worst_usd = max(self.worst_usd, other.worst_usd)
        return TrialCalls(self.usual + other.usual, self.most + other.most, worst_usd)


@dataclass(slots=True)
class Answers:
    """The number of measured answers, and what they cost together in USD."""

    number: int = 0
    usd: float = 0.0

    def add(self, usd: float, number: int = 1) -> None:
        """Count an answer, or several that cost so much together."""
        self.number += number
        self.usd += usd


class TrialCosts:
    """The expected costs of trials, which are named by their order in the sweep.

    ``cell_of`` names a trial's cell, ``calls`` are those of a trial by cell and model, ``earlier``
    the answers of each model to similar requests in earlier runs.
    """

    def __init__(
        self,
        cell_of: Callable[[int], str],
        calls: Mapping[str, Mapping[str, TrialCalls]],
        earlier: Mapping[str, Answers],
    ) -> None:
        self._cell_of = cell_of
        self._calls = calls
        self._answers = defaultdict(Answers, earlier)

    def usd(self, trial: int) -> float:
        """Return the USD that a trial is expected to cost."""
        calls = self._calls.get(self._cell_of(trial), {})
        return sum(_usd(each, self._answers[model]) for model, each in calls.items())

    def models(self, trial: int) -> Collection[str]:
        """Return the models that a trial asks."""
        return self._calls.get(self._cell_of(trial), {})

    def learn(self, model: str, usd: float) -> None:
        """Count the cost of an answer of a model."""
        self._answers[model].add(usd)


def _usd(calls: TrialCalls, answers: Answers) -> float:
    most_usd = calls.most * calls.worst_usd
    if not answers.number:
        return most_usd
    # The worst case counts as one more answer: a few cheap ones prove little.
    mean_usd = (answers.usd + calls.worst_usd) / (answers.number + 1)
    # Up to its last call a trial must be able to reserve that call's worst case.
    return min(most_usd, MARGIN * calls.usual * mean_usd + calls.worst_usd)
