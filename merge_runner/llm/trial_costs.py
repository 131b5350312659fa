"""What a whole trial is expected to cost, from the calls that are measured so far.

It decides which trials begin, never what may be spent: each attempt still sets its own worst case
aside. Before anything is measured a trial is expected to cost as much as it can.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass

# Trials that turn out longer, and attempts that are charged but bring no answer.
MARGIN = 1.5
# With fewer answers of its own a cell borrows from its model's other answers.
ENOUGH = 30


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
    """How many answers are measured, and what they cost together in USD."""

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
        self._by_model = defaultdict(Answers, earlier)
        self._by_cell: defaultdict[tuple[str, str], Answers] = defaultdict(Answers)
        self._expected: dict[str, float] = {}

    def usd(self, trial: int) -> float:
        """What the trial is expected to cost in USD."""
        cell = self._cell_of(trial)
        if cell not in self._expected:
            calls = self._calls.get(cell, {})
            self._expected[cell] = sum(self._usd(cell, model) for model in calls)
        return self._expected[cell]

    def models(self, trial: int) -> Collection[str]:
        """The models that the trial asks."""
        return self._calls.get(self._cell_of(trial), {})

    def learn(self, trial: int, model: str, usd: float) -> None:
        """An answer to a call of this trial cost so much."""
        self._by_model[model].add(usd)
        self._by_cell[self._cell_of(trial), model].add(usd)
        self._expected.clear()

    def _usd(self, cell: str, model: str) -> float:
        calls = self._calls[cell][model]
        own, alike = self._by_cell[cell, model], self._by_model[model]
        most_usd = calls.most * calls.worst_usd
        if not alike.number:
            return most_usd
        borrowed = max(0, min(ENOUGH, alike.number) - own.number)
        usd = own.usd + borrowed * alike.usd / alike.number
        # The worst case counts as one more answer: a few cheap ones prove little.
        each_usd = (usd + calls.worst_usd) / (own.number + borrowed + 1)
        # Up to its last call a trial must be able to set that call's worst case aside.
        return min(most_usd, MARGIN * calls.usual * each_usd + calls.worst_usd)
