"""The result of every statistic, from a fit to the cell of a table."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from math import inf

from merge_runner_analysis.wording import Fact


@dataclass(frozen=True, slots=True)
class Estimate:
    """A number with its interval, what it rests on and its test; what is not known is None.

    The interval has this ``level``, and ``ends_at`` finds the ends at another one, if it is not
    Student's t.

    ``n`` are the trials that it rests on; a rate counts ``k`` of them and is as good as one of
    ``weight`` trials. With ``undecided`` trials a rate has no value, and its interval holds whether
    none or all of them count (Manski 1989). ``se`` is its standard error and ``freedom`` that of
    its Student's t, infinite where the test is another one. ``p`` is two-sided, against 0, and
    ``p_holm`` corrected over a family. ``detectable`` is the smallest true value, in either
    direction, that one test at 5 % finds with a power of 0.8. ``problem`` says why something is
    missing, and ``source`` that it is published.
    """

    value: float | None = None
    low: float | None = None
    high: float | None = None
    n: int = 0
    se: float | None = None
    freedom: float = inf
    weight: float | None = None
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

    def times(self, factor: float) -> Estimate:
        """Return the same in another unit, as a share in percent; not its weight or its trials."""
        ends = (self.value, self.low, self.high, self.se, self.detectable)
        value, low, high, se, least = (None if end is None else factor * end for end in ends)
        return replace(self, value=value, low=low, high=high, se=se, detectable=least)
