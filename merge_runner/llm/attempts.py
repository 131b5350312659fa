"""Counts of calls and attempts, for the display."""

from __future__ import annotations

from collections import Counter, deque
from dataclasses import dataclass, field, fields


@dataclass(slots=True)
class Meter:
    """Counts of calls, attempts and cost.

    ``calls_cached`` were answered without a request: ``calls_shared`` by a call of this run for
    another trial, ``calls_recorded`` by a recording that the user named, others by the cache.
    ``mock_replies`` counts replies that a mock model gave for this one, ``underpriced`` replies
    that cost more than the registry knows, by service tier. ``damaged`` are the keys of recorded
    replies in quarantine, ``notes`` lines for the user.
    """

    calls_live: int = 0
    calls_cached: int = 0
    calls_shared: int = 0
    calls_recorded: int = 0
    cost_usd: float = 0.0
    cost_unknown: int = 0
    outcomes: Counter[str] = field(default_factory=Counter)
    mismatches: Counter[str] = field(default_factory=Counter)
    mock_replies: int = 0
    underpriced: Counter[str] = field(default_factory=Counter)
    notes: deque[str] = field(default_factory=deque)
    damaged: list[str] = field(default_factory=list)

    @property
    def answered(self) -> tuple[int, int, int, int]:
        """Calls: live, cached, and of these shared and recorded."""
        return self.calls_live, self.calls_cached, self.calls_shared, self.calls_recorded

    def add(self, other: Meter) -> None:
        """Add the counts of another meter."""
        for name in (counted.name for counted in fields(self)):
            setattr(self, name, getattr(self, name) + getattr(other, name))
