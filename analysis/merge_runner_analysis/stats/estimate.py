"""The result of every statistic, from a fit to the cell of a table."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from math import inf

import numpy as np
from numpy.typing import NDArray

from merge_runner_analysis.facts import Fact

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Estimate:
    """A number with its interval, counts and test; None: unknown.

    ``ends_at`` returns the interval at another ``level``; without it, Student's t gives that. A
    rate has ``k`` hits in ``n`` trials; for the share of valid replies, ``k`` counts replies and
    ``n`` trials. A weighted rate of humans is as precise as that of ``effective_n`` independent
    trials. With ``undecided`` trials a rate has no value, and its interval holds both worst cases
    (Manski 1989). ``freedom`` is infinite where the test is not Student's t. ``p`` is two-sided,
    against 0, ``p_holm`` corrected over a family, ``detectable`` the minimum detectable effect at
    80 % power. ``problem`` says why a number is missing, ``source`` names its publication.
    """

    value: float | None = None
    low: float | None = None
    high: float | None = None
    n: int = 0
    se: float | None = None
    freedom: float = inf
    effective_n: float | None = None
    p: float | None = None
    detectable: float | None = None
    k: int | None = None
    undecided: int = 0
    problem: Fact | None = None
    source: Fact | None = None
    level: float = 0.95
    p_holm: float | None = None
    ends_at: Callable[[float], tuple[float, float] | None] | None = None

    def bounds(self) -> tuple[float, float] | None:
        """Return both ends of the interval."""
        if self.low is None or self.high is None:
            return None
        return self.low, self.high

    def in_percent(self) -> Estimate:
        """Return the share in percent, with the same counts."""
        ends = (self.value, self.low, self.high, self.se, self.detectable)
        value, low, high, se, least = (None if end is None else 100 * end for end in ends)
        scaled = replace(self, value=value, low=low, high=high, se=se, detectable=least)
        if (ends_at := self.ends_at) is None:
            return scaled

        def percent_at(level: float) -> tuple[float, float] | None:
            bounds = ends_at(level)
            return bounds and (100 * bounds[0], 100 * bounds[1])

        return replace(scaled, ends_at=percent_at)
