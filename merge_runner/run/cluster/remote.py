"""What a worker's clients share with all others: stand-ins that ask the coordinator."""

from __future__ import annotations

import itertools
from collections.abc import AsyncIterator, Sequence
from contextlib import asynccontextmanager
from dataclasses import dataclass
from functools import partial

from merge_runner.llm.cache import CachedCall, KnownCall
from merge_runner.llm.ledger import Asked
from merge_runner.llm.shared_services import Settle
from merge_runner.records import Attempt
from merge_runner.run.cluster.link import Link


@dataclass(frozen=True, slots=True)
class RemoteCache:
    """See ResponseCache: a reply is durable at the coordinator before anyone here sees it."""

    link: Link

    def get(self, key: str) -> None:
        """Always None: a worker learns what is recorded of a call when it claims that call."""

    async def claim(self, key: str) -> KnownCall | None:
        """Claim a call and learn what is recorded of it; None while another one holds it."""
        known: KnownCall | None = await self.link.ask("claim", key)
        return known

    def release(self, key: str) -> None:
        """Give a claim up."""
        self.link.tell("release", key)

    async def put(self, entry: CachedCall, paid: int | None = None) -> CachedCall:
        """Store an entry with the cost of the paid attempt that the coordinator holds as ``paid``.

        Returns the entry that is stored now: this one, or another that was there before.
        """
        other: CachedCall | None = await self.link.ask("keep", entry, paid)
        return other or entry

    async def put_unanswered(self, key: str, attempts: tuple[Attempt, ...]) -> None:
        """Store the attempts at a call that was not answered."""
        await self.link.ask("unanswered", key, attempts)


@dataclass(frozen=True, slots=True)
class RemoteRateLimit:
    """See Limiter: that of the coordinator, so that limits and pauses hold over all workers."""

    link: Link
    name: str

    async def acquire(self, tokens: int, *, order: int = 0) -> Settle:
        """Wait for a turn."""
        number = await self.link.ask("turn", self.name, tokens, order)
        return partial(self.link.tell, "used", number)

    def pause(self, seconds: float) -> None:
        """Make all calls of all workers wait."""
        self.link.tell("pause", self.name, seconds)


@dataclass(frozen=True, slots=True)
class RemoteAttempt:
    """See PaidAttempt: the one that the coordinator holds under this number."""

    link: Link
    number: int
    aside_usd: float

    async def begin(self, attempts: Sequence[Attempt]) -> None:
        """The attempt is sent now."""
        await self.link.ask("begin", self.number, attempts)

    async def settle(self, attempts: Sequence[Attempt]) -> None:
        """The attempt brought no answer."""
        await self.link.ask("settle", self.number, attempts)

    async def keep(self, entry: CachedCall) -> CachedCall:
        """Keep the answer, and what it cost."""
        return await RemoteCache(self.link).put(entry, self.number)


class RemoteBudget:
    """See Budget: that of the coordinator, so that the cap holds over all workers."""

    def __init__(self, link: Link) -> None:
        self._link = link
        self._numbers = itertools.count()

    async def admit(self, trial: int) -> None:
        """Wait until a trial may begin."""
        await self._link.ask("admit", trial)

    def leave(self, trial: int) -> None:
        """The trial has ended or is suspended."""
        self._link.tell("leave", trial)

    @asynccontextmanager
    async def attempt(self, trial: int, key: str, asked: Asked) -> AsyncIterator[RemoteAttempt]:
        """The money of one attempt, which the coordinator sets aside and holds."""
        # The number is chosen here, so that the end can be told in any case: whoever gives up
        # waiting cannot know whether the money was set aside while its answer was under way.
        number = next(self._numbers)
        try:
            aside_usd = await self._link.ask("set_aside", number, trial, key, asked)
            yield RemoteAttempt(self._link, number, aside_usd)
        finally:
            self._link.tell("close", number)
