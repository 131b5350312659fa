"""A cap on spending that holds whatever happens: the worst case is reserved before each attempt."""

from __future__ import annotations

import asyncio

from merge_runner.errors import BudgetExhausted


class Budget:
    """Spending in USD against a cap; without a cap everything passes."""

    def __init__(self, cap_usd: float | None = None) -> None:
        self.cap_usd = cap_usd
        self._committed_usd = 0.0
        self._in_flight = 0
        self._settled = asyncio.Event()

    async def reserve(self, worst_usd: float) -> None:
        """Set the worst case aside; waits for attempts in flight, else raises BudgetExhausted."""
        cap = self.cap_usd
        if cap is None:
            return
        while self._committed_usd + worst_usd > cap:
            if self._in_flight == 0:
                raise BudgetExhausted(
                    f"the next call may cost {worst_usd:.4f} USD and {self._committed_usd:.4f} of "
                    f"{cap:.2f} USD are spent: raise --max-cost and run the same command again"
                )
            self._settled.clear()
            await self._settled.wait()
        self._committed_usd += worst_usd
        self._in_flight += 1

    def settle(self, worst_usd: float, actual_usd: float | None) -> None:
        """Replace the worst case by the actual cost; None (unknown) keeps it."""
        if self.cap_usd is None:
            return
        if actual_usd is not None:
            self._committed_usd += actual_usd - worst_usd
        self._in_flight -= 1
        self._settled.set()
