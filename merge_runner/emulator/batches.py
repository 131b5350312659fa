"""Batches on the emulator's own clock: what becomes of each line, and when."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

from merge_runner.chance import draw, draw_between, draw_index
from merge_runner.emulator.faults import OUTCOMES, FaultPlan
from merge_runner.emulator.replies import Asked, Replies, marked
from merge_runner.errors import UsageError

FAILURES = (429, 500, 503)
Outcome = Literal["answered", "failed", "expired"]


@dataclass(frozen=True, slots=True)
class Fate:
    """When a line has its result, in seconds from the batch's beginning, and which."""

    after_s: float
    kind: Outcome


@dataclass(frozen=True, slots=True)
class Result:
    """A status and a body as the plain endpoint would reply; None for a line that was not asked."""

    custom_id: str
    status: int | None
    body: dict[str, Any] | None


@dataclass(slots=True, eq=False)
class Batch:
    """Lines that were submitted together; times are in seconds of the clock.

    ``name`` is the client's own for the batch. ``details`` is what an API keeps beside it.
    ``refused`` says why the lines are not asked at all. ``results`` are there once it has ended, in
    the order in which they came.
    """

    id: str
    name: str
    lines: Sequence[Asked]
    fates: Sequence[Fate]
    began_s: float
    least_polls: int
    details: dict[str, Any] = field(default_factory=dict)
    refused: str | None = None
    polls: int = 0
    cancelled_s: float | None = None
    results: list[Result] | None = None

    @property
    def ended(self) -> bool:
        """Whether its results are there."""
        return self.results is not None

    @property
    def due_s(self) -> float:
        """When the last line ends."""
        return self.began_s + max(fate.after_s for fate in self.fates)

    @property
    def tokens(self) -> int:
        """About how many tokens its requests have."""
        return sum(len(line.raw) for line in self.lines) // 4

    def finished(self, now_s: float) -> int:
        """How many lines have their result by now."""
        until_s = now_s if self.cancelled_s is None else self.cancelled_s
        in_time = sum(self.began_s + fate.after_s <= until_s for fate in self.fates)
        if self.polls >= self.least_polls:
            return in_time
        return min(in_time, len(self.lines) * self.polls // self.least_polls)


class Batches:
    """All batches of all APIs, the oldest first."""

    def __init__(self, replies: Replies, clock: Callable[[], float] = time.time) -> None:
        self._replies = replies
        self.now_s = clock
        self._all: dict[str, Batch] = {}
        self._submitted: Counter[str] = Counter()

    @property
    def faults(self) -> FaultPlan:
        """What goes wrong."""
        return self._replies.faults

    def create(
        self, prefix: str, name: str, lines: Sequence[Asked], details: dict[str, Any]
    ) -> Batch:
        """A new batch, with ``refused`` set where more tokens would wait than may."""
        if not lines:
            raise UsageError("A batch needs at least one request.")
        number = len(self._all)
        batch_id = f"{prefix}{draw_index(2**40, 'batch', self.faults.seed, number):010x}"
        fates = [self._fate(line) for line in lines]
        plan = self.faults.batch
        batch = Batch(batch_id, name, lines, fates, self.now_s(), plan.polls, details)
        most = plan.enqueued_tokens
        if most is not None and self._enqueued() + batch.tokens > most:
            batch.refused = f"Enqueued token limit reached. Limit: {most:,} enqueued tokens."
        else:
            self._all[batch_id] = batch
        return batch

    def keep(self, batch: Batch) -> None:
        """Keep one that was refused, as OpenAI does."""
        self._all[batch.id] = batch

    def listed(self, prefix: str) -> list[Batch]:
        """All of an API, as it lists them."""
        self.settle()
        own = [batch for batch in self._all.values() if batch.id.startswith(prefix)]
        return own if self.faults.batch.oldest_first else own[::-1]

    def poll(self, batch_id: str) -> Batch | None:
        """A batch whose state is asked for."""
        batch = self._all.get(batch_id)
        if batch is not None:
            self._settle(batch)
            batch.polls += 1
        return batch

    def cancel(self, batch: Batch) -> None:
        """Ask for the end of a batch, which it reaches at the next look."""
        if not batch.ended and batch.cancelled_s is None:
            batch.cancelled_s = self.now_s()

    def settle(self) -> None:
        """Let all batches end that are due."""
        for batch in self._all.values():
            self._settle(batch)

    def _fate(self, line: Asked) -> Fate:
        """A function of the seed, the line, and how often it was submitted."""
        plan, seed = self.faults.batch, self.faults.seed
        self._submitted[line.where] += 1
        what = (seed, line.where, self._submitted[line.where])
        chance = draw("line", *what)
        after_s = plan.delay_s * draw_between(0.2, 1.0, "when", *what)
        if draw("slow", *what) < plan.slow:
            after_s *= plan.slow_factor
        if chance < plan.failed:
            return Fate(after_s, "failed")
        if chance < plan.failed + plan.expired:
            return Fate(plan.delay_s, "expired")
        return Fate(after_s, "answered")

    def _enqueued(self) -> int:
        self.settle()
        waiting = (each for each in self._all.values() if not each.ended and not each.refused)
        return sum(batch.tokens for batch in waiting)

    def _settle(self, batch: Batch) -> None:
        """Make the results of a batch that is due, or was cancelled."""
        if batch.ended or batch.refused:
            return
        finished = batch.finished(self.now_s())
        if finished < len(batch.lines) and batch.cancelled_s is None:
            return
        fates = sorted(zip(batch.fates, batch.lines, strict=True), key=lambda pair: pair[0].after_s)
        batch.results = [
            self._result(line, fate.kind if number < finished else "expired")
            for number, (fate, line) in enumerate(fates)
        ]

    def _result(self, line: Asked, kind: Outcome) -> Result:
        assert line.custom_id is not None
        if kind == "expired":
            return Result(line.custom_id, None, None)
        if kind == "failed":
            which = draw_index(len(FAILURES), "failure", self.faults.seed, line.where)
            status = FAILURES[which]
            body, _ = line.wire.error(status, "An emulated fault.")
            return Result(line.custom_id, status, marked(body))
        try:
            question = self._replies.question(line)
        except UsageError as exc:
            body, _ = line.wire.error(400, str(exc))
            return Result(line.custom_id, 400, marked(body))
        attempt = self._replies.attempt(line)
        fault = self.faults.fault(line.where, attempt)
        answer = self._replies.answer(question, attempt, fault if fault in OUTCOMES else None)
        return Result(line.custom_id, 200, answer)
