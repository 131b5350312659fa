"""A call that is asked, what it waits for, and the counts of calls for display and summary."""

from __future__ import annotations

import asyncio
from collections import Counter, deque
from dataclasses import dataclass, field, fields
from datetime import datetime
from typing import TYPE_CHECKING

from merge_runner.llm.ledger import Asked
from merge_runner.records import Attempt, ChatReply, ChatRequest, Usage

if TYPE_CHECKING:
    from merge_runner.llm.batch.rounds import Batch


@dataclass(frozen=True, slots=True)
class Wait:
    """What a call waits for, and until when (UTC); None: until it happens.

    It is ``idle`` where what it waits for does not happen by itself: an answer that makes room, or
    that is somebody else's. It is ``paid`` where the answer may be charged already.
    """

    what: str
    until: datetime | None = None
    idle: bool = False
    paid: bool = False


@dataclass(slots=True, eq=False)
class Call:
    """A call that somebody waits for.

    ``asked`` names it for a reader and bounds the cost of an attempt, ``worst`` bounds its tokens.
    ``left_s`` is what its attempts and the waits between them may take yet; standing in the queue
    of the limiter is no fault of the provider. ``attempts`` are all that were made, the first
    ``earlier`` of them by earlier runs. While the call waits, ``wait`` says for what; otherwise it
    is in flight, or being saved. ``task`` makes it. ``asking`` counts those who wait for its
    answer. It goes ``singly`` where a batch brought no answer, and ``open`` says in which batch it
    waits already. What is recorded of it may be ``damaged``.
    """

    request: ChatRequest
    order: int
    asked: Asked
    worst: Usage
    left_s: float
    damaged: bool = False
    attempts: list[Attempt] = field(default_factory=list)
    earlier: int = 0
    wait: Wait | None = None
    asking: int = 0
    singly: bool = False
    open: Batch | None = None
    task: asyncio.Task[ChatReply] = field(init=False)

    @property
    def own_attempts(self) -> list[Attempt]:
        """The attempts of this run."""
        return self.attempts[self.earlier :]

    @property
    def empty(self) -> int:
        """The number of empty answers in this run."""
        return sum(attempt.outcome == "empty" for attempt in self.own_attempts)

    @property
    def last_failure(self) -> str:
        """The reason why the last attempt brought no answer."""
        return self.attempts[-1].error or self.attempts[-1].outcome


@dataclass(slots=True)
class Meter:
    """Counts of calls, attempts and cost.

    ``calls_shared`` are those of ``calls_cached`` that this run has asked, for another trial, and
    ``calls_recorded`` those of a recording that was named.
    ``stand_ins`` counts the answers that a scripted stand-in gave in the model's name;
    ``underpriced`` those that cost more than the registry knows, by service tier; ``damaged`` are
    the keys of recorded replies that could not be read.
    """

    calls_live: int = 0
    calls_cached: int = 0
    calls_shared: int = 0
    calls_recorded: int = 0
    cost_usd: float = 0.0
    cost_unknown: int = 0
    outcomes: Counter[str] = field(default_factory=Counter)
    mismatches: Counter[str] = field(default_factory=Counter)
    stand_ins: int = 0
    underpriced: Counter[str] = field(default_factory=Counter)
    notes: deque[str] = field(default_factory=deque)
    damaged: list[str] = field(default_factory=list)

    @property
    def answered(self) -> tuple[int, int, int, int]:
        """The calls: live, cached, and of these shared and recorded."""
        return self.calls_live, self.calls_cached, self.calls_shared, self.calls_recorded

    def count_attempt(self, attempt: Attempt) -> None:
        """Count one live attempt."""
        self.outcomes[attempt.outcome] += 1
        self.cost_usd += attempt.cost_usd or 0.0
        self.cost_unknown += attempt.cost_usd is None

    def add(self, other: Meter) -> None:
        """Add what another meter has counted."""
        for each in fields(self):
            setattr(self, each.name, getattr(self, each.name) + getattr(other, each.name))
