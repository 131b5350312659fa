"""A line of a batch: an attempt at a call that waits for its batch, and what becomes of it."""

from __future__ import annotations

import asyncio
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Protocol

from merge_runner.errors import MergeRunnerError
from merge_runner.llm.batch.journal import OpenLine
from merge_runner.llm.batch.service import BatchLine
from merge_runner.llm.http_outcome import RawReply
from merge_runner.records import Attempt


@dataclass(frozen=True, slots=True)
class LineEnd:
    """What became of a line.

    Without a ``raw`` reply ``outcome`` names why, and nothing was charged unless it is ``unclear``.
    Then it is asked again: ``singly`` or in another batch. An ``error`` ends the sweep.
    """

    batch_id: str | None
    raw: RawReply | None = None
    outcome: str = ""
    message: str = ""
    unclear: bool = False
    singly: bool = False
    error: MergeRunnerError | None = None


class Money(Protocol):
    """The money of an attempt; see budget.PaidAttempt."""

    def set_aside(self, attempts: Sequence[Attempt]) -> bool:
        """An operation on the cache: the attempt begins, after these; False if a cap forbids it."""
        ...

    def begun(self) -> None:
        """What ``set_aside`` wrote is durable."""
        ...


@dataclass(slots=True, eq=False)
class Line:
    """An attempt that waits for a batch to be submitted, or to end; ``open`` where it is in one.

    ``model`` is its name in the registry, ``ledger`` that of its ``money``, ``attempts`` are those
    before it.
    """

    line: BatchLine
    model: str
    ledger: str
    money: Money
    attempts: tuple[Attempt, ...]
    open: OpenLine | None = None
    end: asyncio.Future[LineEnd] = field(init=False)

    @property
    def key(self) -> str:
        """That of its call."""
        return self.line.key

    def ends(self, end: LineEnd) -> None:
        """Tell who waits for it."""
        if not self.end.done():
            self.end.set_result(end)

    def fails(self, error: BaseException) -> None:
        """Raise this for who waits for it."""
        if not self.end.done():
            self.end.set_exception(error)
