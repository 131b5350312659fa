"""A call under way, with what it has tried and what it waits for, and the counts of all calls."""

from __future__ import annotations

import asyncio
import time
from collections import Counter, deque
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, fields, replace
from datetime import datetime

from merge_runner.errors import CallFailed
from merge_runner.llm.batch.journal import OpenLine
from merge_runner.llm.ledger import Asked
from merge_runner.records import Attempt, ChatReply, ChatRequest, Slot, Usage

MINUTE_S = 60.0


@dataclass(frozen=True, slots=True)
class Wait:
    """Who waits for what, and until when (UTC); None: until it happens.

    It is ``idle`` where what it waits for does not happen by itself: an answer that makes room, or
    that is somebody else's.
    """

    who: str
    what: str
    until: datetime | None = None
    idle: bool = False


@dataclass(slots=True, eq=False)
class Call:
    """A call that somebody waits for.

    ``asked`` names it for a reader and bounds the cost of an attempt, ``worst`` bounds its tokens.
    ``attempts`` are all that were made, the first ``earlier`` of them by earlier runs. ``began_s``
    is when the first attempt was due, on the event loop's clock. While the call waits, ``wait``
    says for what; otherwise it is in flight, or being saved. A call that is ``stopping`` waits for
    nothing any more. ``task`` makes it. ``asking`` counts those who wait for its answer. It goes
    ``singly`` where a batch brought no answer, and ``open`` says in which batch it waits already.
    """

    request: ChatRequest
    order: int
    asked: Asked
    worst: Usage
    stopping: bool
    attempts: list[Attempt] = field(default_factory=list)
    earlier: int = 0
    began_s: float = 0.0
    wait: Wait | None = None
    asking: int = 0
    singly: bool = False
    open: OpenLine | None = None
    task: asyncio.Task[ChatReply] = field(init=False)

    @property
    def own_attempts(self) -> list[Attempt]:
        """The attempts of this run."""
        return self.attempts[self.earlier :]

    @property
    def last_failure(self) -> str:
        """The reason why the last attempt brought no answer."""
        last = self.attempts[-1]
        return last.error or last.outcome

    @contextmanager
    def waiting(
        self, what: str, until: datetime | None = None, *, idle: bool = False
    ) -> Iterator[Wait]:
        """Mark the call as waiting, so that it can be given up: nothing of it is in flight."""
        if self.stopping:
            raise CallFailed("the sweep was stopped", self.request)
        self.wait = wait = Wait(f"{self.asked.driver}: {self.asked.slot}", what, until, idle)
        try:
            yield wait
        finally:
            self.wait = None

    def stop(self) -> None:
        """Give the call up: at once if it waits, otherwise as soon as it would wait again."""
        self.stopping = True
        # What is in flight may be charged whether or not anybody takes the answer: it goes on.
        if self.wait is not None:
            self.task.cancel()


def slot_text(slot: Slot) -> str:
    """Format a slot for a reader."""
    return f"{slot.condition} rep {slot.repetition} {slot.side}, decision {slot.decision}"


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
        self.cost_usd += attempt.cost_usd or 0.0
        self.cost_unknown += attempt.cost_usd is None
        tokens = (attempt.usage.input_tokens or 0) + (attempt.usage.output_tokens or 0)
        self.events.append((time.monotonic(), tokens))

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
