"""What a client shares with others: limits, claims and money, in this process or elsewhere.

Limiter, Claims and Budget are those of one process; on a cluster they are the coordinator's, and
stand-ins at each worker ask there (run/cluster/remote.py).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import AbstractAsyncContextManager
from typing import Protocol

from merge_runner.llm.cache import Entry
from merge_runner.llm.ledger import Asked
from merge_runner.records import Attempt


class PermitPort(Protocol):
    """See limiter.Permit."""

    def settle(self, tokens: int) -> None:
        """Replace the estimate by the actual usage."""
        ...


class RateLimitPort(Protocol):
    """See limiter.Limiter."""

    async def acquire(self, tokens: int, *, order: int = 0) -> PermitPort:
        """Wait for a turn."""
        ...

    def pause(self, seconds: float) -> None:
        """Dispatch nothing for a while."""
        ...


class ClaimPort(Protocol):
    """See claims.Claims."""

    async def claim(self, key: str) -> bool:
        """Claim a key; False while another one holds it."""
        ...

    def release(self, key: str) -> None:
        """Give a claim up."""
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

    async def keep(self, entry: Entry) -> Entry:
        """Keep the answer that the attempt brought; returns the one that is kept."""
        ...


class BudgetPort(Protocol):
    """See budget.Budget."""

    async def admit(self, trial: int) -> None:
        """Wait for a trial's allowance."""
        ...

    def leave(self, trial: int) -> None:
        """The trial has ended or is suspended."""
        ...

    def attempt(
        self, trial: int, key: str, asked: Asked
    ) -> AbstractAsyncContextManager[AttemptPort]:
        """The money of one attempt at the call with this key."""
        ...


class SharedServices(Protocol):
    """Where clients get turns, by model, and money and claims."""

    @property
    def limiters(self) -> Mapping[str, RateLimitPort]:
        """The queue of each model."""
        ...

    @property
    def budget(self) -> BudgetPort:
        """That of the models that cost money."""
        ...

    @property
    def claims(self) -> ClaimPort:
        """Who asks what."""
        ...
