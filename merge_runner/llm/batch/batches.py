"""How one model is asked in batches: with whose money, at what part of the price."""

from __future__ import annotations

from collections.abc import AsyncIterator
from contextlib import AsyncExitStack, asynccontextmanager
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from merge_runner.llm.batch.journal import OpenLine
from merge_runner.llm.batch.lines import Line
from merge_runner.llm.batch.rounds import Rounds
from merge_runner.llm.batch.service import BatchLine
from merge_runner.llm.budget import Budget, PaidAttempt

if TYPE_CHECKING:
    from merge_runner.llm.call import Call


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
        """The money of a call's next attempt, and its line, which may be ``opened`` already."""
        key, ledger = call.request.key, self.ledger
        asked = replace(call.asked, honest_usd=call.asked.honest_usd * self.price_factor)
        async with AsyncExitStack() as stack:
            if opened is None:
                with call.waiting("for calls in flight to be paid, under --max-cost", idle=True):
                    paid = await stack.enter_async_context(
                        self.money.attempt(call.order, key, asked)
                    )
            else:
                ledger = self.rounds.ledger_of(opened)
                paid = await stack.enter_async_context(
                    self.money.going_on(call.order, key, asked, ledger)
                )
            attempts = tuple(call.attempts)
            sent = BatchLine(call.request, len(attempts) + 1)
            yield paid, Line(sent, self.model, ledger, paid, attempts, opened)
