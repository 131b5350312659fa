"""What a client has done so far, for the display and the summary."""

from __future__ import annotations

import time
from collections import Counter, deque
from dataclasses import dataclass, field, fields, replace

from merge_runner.records import Attempt

MINUTE_S = 60.0


@dataclass(slots=True)
class Meter:
    """Counts of calls, attempts, tokens and cost; ``events`` holds the last minute's attempts.

    ``stand_ins`` counts the answers that a scripted stand-in gave in the model's name; ``damaged``
    are the keys of recorded replies that could not be read.
    """

    calls_live: int = 0
    calls_cached: int = 0
    cost_usd: float = 0.0
    cost_unknown: int = 0
    outcomes: Counter[str] = field(default_factory=Counter)
    mismatches: Counter[str] = field(default_factory=Counter)
    stand_ins: int = 0
    notes: deque[str] = field(default_factory=deque)
    damaged: list[str] = field(default_factory=list)
    events: deque[tuple[float, int]] = field(default_factory=deque)

    def count_attempt(self, attempt: Attempt) -> None:
        """Count one live attempt."""
        self.outcomes[attempt.outcome] += 1
        usage = attempt.usage
        self.events.append(
            (time.monotonic(), (usage.input_tokens or 0) + (usage.output_tokens or 0))
        )
        if attempt.cost_usd is not None:
            self.cost_usd += attempt.cost_usd
        else:
            self.cost_unknown += 1

    def add(self, other: Meter) -> None:
        """Add what another meter has counted."""
        # The other's clock may be another machine's: what it has just counted counts as of now.
        now = time.monotonic()
        counted = replace(other, events=deque((now, tokens) for _, tokens in other.events))
        for each in fields(self):
            setattr(self, each.name, getattr(self, each.name) + getattr(counted, each.name))

    def last_minute(self) -> tuple[int, int]:
        """Return the requests and tokens of the last minute."""
        now = time.monotonic()
        while self.events and now - self.events[0][0] > MINUTE_S:
            self.events.popleft()
        return len(self.events), sum(tokens for _, tokens in self.events)
