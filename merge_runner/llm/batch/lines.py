"""A call as a line of a batch: with whose money it waits, and how that ends."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from contextlib import ExitStack, asynccontextmanager
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

from merge_runner.errors import MergeRunnerError
from merge_runner.llm.batch.journal import OpenLine
from merge_runner.llm.batch.service import BatchLine
from merge_runner.llm.budget import Budget, PaidAttempt
from merge_runner.llm.http_outcome import RawReply
from merge_runner.records import Attempt

if TYPE_CHECKING:
    from merge_runner.llm.batch.rounds import Rounds
    from merge_runner.llm.client import Call


@dataclass(frozen=True, slots=True)
class LineEnd:
    """How a line ended.

    Without a ``raw`` reply ``outcome`` names why, and nothing was charged unless it is ``unclear``.
    Then it is asked singly. An ``error`` ends the sweep.
    """

    batch_id: str | None = None
    raw: RawReply | None = None
    outcome: str = ""
    message: str = ""
    unclear: bool = False
    error: MergeRunnerError | None = None


@dataclass(slots=True, eq=False)
class Line:
    """An attempt that waits for a batch to be created, or to end; ``open`` where it is in one.

    ``model`` is its name in the registry, ``ledger`` that of its ``money``, ``attempts`` are those
    before it.
    """

    line: BatchLine
    model: str
    ledger: str
    money: PaidAttempt
    attempts: tuple[Attempt, ...]
    open: OpenLine | None = None
    end: asyncio.Future[LineEnd] = field(init=False)

    @property
    def key(self) -> str:
        """That of its call."""
        return self.line.key

    @property
    def submitted_at(self) -> str | None:
        """When its batch was submitted, in UTC; None: it was in none."""
        if self.open is None:
            return None
        return self.open.batch.submitted_at.isoformat(timespec="milliseconds")

    def ends(self, end: LineEnd) -> None:
        """Give its end to the call that waits for it."""
        if not self.end.done():
            self.end.set_result(end)

    def fails(self, error: BaseException) -> None:
        """Raise an error in the call that waits for it."""
        if not self.end.done():
            self.end.set_exception(error)


@dataclass(frozen=True, slots=True)
class Batches:
    """The batches of one model; ``model`` is its name in the registry, ``ledger`` the money's."""

    rounds: Rounds
    model: str
    ledger: str
    money: Budget
    price_factor: float

    def takes_up(self, call: Call) -> bool:
        """Whether a call waits in a batch already, so that its trial has begun."""
        if self.rounds.open_line(call.request.key) is None:
            return False
        self.money.begin_anew(call.order)
        return True

    @asynccontextmanager
    async def attempt(
        self, call: Call, opened: OpenLine | None
    ) -> AsyncIterator[tuple[PaidAttempt, Line]]:
        """Yield the money of a call's next attempt, and its line, which may be ``opened``."""
        asked = replace(call.asked, honest_usd=call.asked.honest_usd * self.price_factor)
        who = (call.order, call.request.key, asked)
        ledger = opened.batch.ledger if opened else self.ledger
        with ExitStack() as stack:
            if opened is None:
                with call.waiting("for calls in flight to be paid, under --max-cost", idle=True):
                    paid = await self.money.set_aside(*who)
            else:
                paid = self.money.going_on(*who, ledger)
            stack.callback(paid.close)
            attempts = tuple(call.attempts)
            sent = BatchLine(call.request, len(attempts) + 1)
            yield paid, Line(sent, self.model, ledger, paid, attempts, opened)
