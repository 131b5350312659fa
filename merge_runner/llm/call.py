"""A call under way: what it has tried so far, and whether anything of it is in flight."""

from __future__ import annotations

import asyncio
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from datetime import datetime

from merge_runner.errors import CallFailed
from merge_runner.llm.batch.rounds import Batch
from merge_runner.llm.ledger import Asked
from merge_runner.records import Attempt, ChatReply, ChatRequest, Slot, Usage


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
    open: Batch | None = None
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

    def failed(self, why: str) -> CallFailed:
        """Return the error of a call that ends without an answer."""
        return CallFailed(why, self.request, tuple(self.attempts), self.earlier)


def slot_text(slot: Slot) -> str:
    """Format a slot for a reader."""
    return f"{slot.condition} rep {slot.repetition} {slot.side}, decision {slot.decision}"
