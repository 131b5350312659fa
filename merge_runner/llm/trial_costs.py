"""What a whole trial is expected to cost: the mean of its models' answers, for each usual call.

It decides which trials begin, never what may be spent: each attempt still reserves its own worst
case. Before anything is measured a trial is expected to cost as much as it can.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

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

    def expected_usd(self, answers: Answers) -> float:
        """Return what the calls cost together, if they cost as much as these answers."""
        most_usd = self.most * self.worst_usd
        if not answers.number:
            return most_usd
        # The worst case counts as one more answer: a few cheap ones prove little.
        mean_usd = (answers.usd + self.worst_usd) / (answers.number + 1)
        # Up to its last call a trial must be able to reserve that call's worst case.
        return min(most_usd, MARGIN * self.usual * mean_usd + self.worst_usd)


@dataclass(slots=True)
class Answers:
    """The number of measured answers, and what they cost together in USD."""

    number: int = 0
    usd: float = 0.0

    def add(self, usd: float, number: int = 1) -> None:
        """Count an answer, or several that cost so much together."""
        self.number += number
        self.usd += usd


@dataclass(frozen=True, slots=True)
class TrialCosts:
    """The expected costs of trials, which are named by their order in the sweep.

    ``calls`` returns a trial's by model; ``answers`` are those of each model to similar requests,
    of earlier runs, too.
    """

    calls: Callable[[int], Mapping[str, TrialCalls]]
    answers: defaultdict[str, Answers] = field(default_factory=lambda: defaultdict(Answers))

    def usd(self, trial: int) -> float:
        """Return the USD that a trial is expected to cost."""
        calls = self.calls(trial)
        return sum(each.expected_usd(self.answers[model]) for model, each in calls.items())
