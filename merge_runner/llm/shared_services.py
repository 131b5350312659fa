"""What a client shares with others: replies, limits and money, in this process or elsewhere.

ResponseCache, Limiter and Budget are those of one process; on a cluster they are the coordinator's,
and stand-ins at each worker ask there (run/cluster/remote.py).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import AbstractAsyncContextManager
from typing import Protocol

from merge_runner.llm.cache import CachedCall, KnownCall
from merge_runner.llm.ledger import Asked
from merge_runner.records import Attempt

# Replaces the estimate with which a request was let through by the tokens that it used.
Settle = Callable[[int], None]


class CachePort(Protocol):
    """See cache.ResponseCache."""

    def get(self, key: str) -> CachedCall | None:
        """What is recorded of a call, as far as that is known before it is claimed."""
        ...

    async def claim(self, key: str) -> KnownCall | None:
        """Claim a call and learn what is recorded of it; None while another one holds it."""
        ...

    def release(self, key: str) -> None:
        """Give a claim up."""
        ...

    async def put(self, entry: CachedCall) -> CachedCall:
        """Keep an answered call durably; returns the one that is kept."""
        ...

    async def put_unanswered(self, key: str, attempts: tuple[Attempt, ...]) -> None:
        """Keep the attempts at a call without an answer durably."""
        ...


class RateLimitPort(Protocol):
    """See limiter.Limiter."""

    async def acquire(self, tokens: int, *, order: int = 0) -> Settle:
        """Wait for a turn."""
        ...

    def pause(self, seconds: float) -> None:
        """Dispatch nothing for a while."""
        ...


class AttemptPort(Protocol):
    """The money of one attempt; see budget.PaidAttempt."""

    @property
    def aside_usd(self) -> float:
        """What is set aside for it."""
        ...

    async def begin(self, attempts: Sequence[Attempt]) -> None:
        """The attempt is sent now, after these."""
        ...

    async def settle(self, attempts: Sequence[Attempt]) -> None:
        """The attempt, the last of these, brought no answer."""
        ...

    async def keep(self, entry: CachedCall) -> CachedCall:
        """Keep the answer that the attempt brought; returns the one that is kept."""
        ...


class BudgetPort(Protocol):
    """See budget.Budget."""

    async def admit(self, trial: int) -> None:
        """Wait until a trial may begin."""
        ...

    def leave(self, trial: int) -> None:
        """The trial has ended or is suspended."""
        ...

    def attempt(
        self, trial: int, key: str, asked: Asked
    ) -> AbstractAsyncContextManager[AttemptPort]:
        """The money of one attempt at the call with this key."""
        ...
