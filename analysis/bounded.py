"""A value with its interval, computed or published."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Bounded:
    """A value with its 95 % interval; None where there is none."""

    value: float | None
    low: float | None
    high: float | None

    def bounds(self, factor: float = 1.0) -> tuple[float, float] | None:
        """Both ends of the interval, in units of 1 / ``factor``."""
        if self.low is None or self.high is None:
            return None
        return factor * self.low, factor * self.high
