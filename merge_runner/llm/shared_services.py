"""What a client shares with others: limits, claims and money, in this process or elsewhere.

Limiter, Claims, Budget and Ledger are those of one process; on a cluster they are the
coordinator's, and stand-ins at each worker ask there.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Protocol

from merge_runner.llm.cache import Entry
from merge_runner.llm.ledger import Asked
from merge_runner.records import Attempt


class Turn(Protocol):
    """See limiter.Permit."""

    def settle(self, tokens: int) -> None:
        """Replace the estimate by the actual usage."""
        ...


class Turns(Protocol):
    """See limiter.Limiter."""

    async def acquire(self, tokens: int, *, order: int = 0) -> Turn:
        """Wait for a turn."""
        ...

    def pause(self, seconds: float) -> None:
        """Dispatch nothing for a while."""
        ...


class Claiming(Protocol):
    """See claims.Claims."""

    async def claim(self, key: str) -> bool:
        """Claim a key; False while another one holds it."""
        ...

    def release(self, key: str) -> None:
        """Give a claim up."""
        ...


class Account(Protocol):
    """See ledger.Ledger."""

    async def settle(
        self, key: str, attempts: list[Attempt], worst_usd: float, actual_usd: float | None
    ) -> None:
        """An attempt brought no answer."""
        ...

    async def keep(self, entry: Entry, worst_usd: float, actual_usd: float | None) -> Entry:
        """Keep an answered call, and settle its last attempt with it."""
        ...


class Purse(Protocol):
    """See budget.Budget."""

    @property
    def ledger(self) -> Account:
        """Where what is spent is noted."""
        ...

    async def admit(self, trial: int) -> None:
        """Wait for a trial's allowance."""
        ...

    def leave(self, trial: int) -> None:
        """The trial has ended or is suspended."""
        ...

    async def reserve(self, trial: int, worst_usd: float, driver: str) -> float:
        """Set an attempt's worst case aside; returns what is set aside."""
        ...

    async def begin(
        self, key: str, attempts: list[Attempt], worst_usd: float, asked: Asked
    ) -> None:
        """The attempt is sent now."""
        ...

    def give_back(self, trial: int, worst_usd: float) -> None:
        """The attempt was not begun."""
        ...

    def settled(self, trial: int, freed_usd: float = 0.0) -> None:
        """An attempt has ended."""
        ...


class Desk(Protocol):
    """Where clients get turns, by model, and money and claims."""

    @property
    def limiters(self) -> Mapping[str, Turns]:
        """The queue of each model."""
        ...

    @property
    def budget(self) -> Purse:
        """That of the models that cost money."""
        ...

    @property
    def claims(self) -> Claiming:
        """Who asks what."""
        ...
