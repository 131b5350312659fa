"""What a worker's clients share with all others: stand-ins that ask the coordinator."""

from __future__ import annotations

import asyncio
import itertools
from collections.abc import AsyncIterator, Mapping, Sequence
from contextlib import asynccontextmanager
from dataclasses import dataclass, replace
from pathlib import Path

from merge_runner.errors import RecordingError
from merge_runner.llm.cache import Entry, ResponseCache
from merge_runner.llm.ledger import Asked
from merge_runner.llm.limiter import Limiter
from merge_runner.llm.shared_services import RateLimitPort
from merge_runner.llm.write_batcher import Operation
from merge_runner.records import Attempt
from merge_runner.run.cluster.batch import KnownCall
from merge_runner.run.cluster.link import Link


class WorkerCache(ResponseCache):
    """Replies on the worker's own disk, until the coordinator has them.

    What is recorded of a call is known while the call is claimed.
    """

    def __init__(self, folder: Path, link: Link) -> None:
        super().__init__(folder)
        self.known: dict[str, KnownCall] = {}
        self._link = link
        self._sending: dict[str, asyncio.Task[None]] = {}

    def get(self, key: str) -> Entry | None:
        """What the main cache holds, else what a worker that died has left on this disk."""
        known = self.known.get(key)
        if known is None:
            return None
        if known.damaged:
            raise RecordingError("what the main cache held of the call is damaged")
        if known.entry is not None:
            return known.entry
        left = super().get(key)
        if left is not None:
            self._send(left)
        return left

    async def put(self, entry: Entry, also: Operation | None = None) -> Entry:
        """Keep an entry on this disk, and send it on meanwhile."""
        kept = await super().put(entry, also)
        self._send(kept)
        return kept

    async def put_paid(self, entry: Entry, attempt: int) -> Entry:
        """Keep an entry on this disk, then in the main cache, with what its attempt cost."""
        kept = await super().put(entry)
        await self._link.ask("keep", entry.to_json(), attempt)
        await self._discard(entry.request.key)
        return kept

    def set_damage_aside(self, key: str) -> list[str]:
        """What was damaged, there or here."""
        known = self.known[key]
        self.known[key] = replace(known, damaged=())
        return [*known.damaged, *super().set_damage_aside(key)]

    def unanswered(self, key: str) -> tuple[Attempt, ...]:
        """The attempts that the main cache knows."""
        known = self.known.get(key)
        return known.attempts if known else ()

    async def put_unanswered(self, key: str, attempts: tuple[Attempt, ...]) -> None:
        """Keep the attempts in the main cache."""
        await self._link.ask("unanswered", key, attempts)

    def sending(self, key: str) -> asyncio.Task[None] | None:
        """The transfer of an entry that is under way."""
        return self._sending.get(key)

    async def sent(self) -> None:
        """Wait until the coordinator has everything, or is gone."""
        await asyncio.gather(*self._sending.values(), return_exceptions=True)

    def _send(self, entry: Entry) -> None:
        key = entry.request.key
        task = asyncio.create_task(self._deliver(entry))
        self._sending[key] = task

        def forget(done: asyncio.Task[None]) -> None:
            del self._sending[key]
            if not done.cancelled():
                done.exception()  # the entry stays on this disk, and whoever failed has told why

        task.add_done_callback(forget)

    async def _deliver(self, entry: Entry) -> None:
        await self._link.ask("keep", entry.to_json(), None)
        await self._discard(entry.request.key)

    async def _discard(self, key: str) -> None:
        await self.write(lambda: self._disk.delete(key))


class RemoteClaims:
    """See Claims: the coordinator claims on behalf of its workers, and tells what is recorded."""

    def __init__(self, link: Link, cache: WorkerCache) -> None:
        self._link = link
        self._cache = cache

    async def claim(self, key: str) -> bool:
        """Claim a key and learn what is known of the call."""
        known: KnownCall | None = await self._link.ask("claim", key)
        if known is None:
            return False
        self._cache.known[key] = known
        return True

    def release(self, key: str) -> None:
        """Give a claim up, once the coordinator has the reply."""
        self._cache.known.pop(key, None)
        if sending := self._cache.sending(key):
            sending.add_done_callback(lambda _: self._link.tell("release", key))
        else:
            self._link.tell("release", key)


@dataclass(frozen=True, slots=True)
class RemotePermit:
    """See Permit."""

    number: int
    link: Link

    def settle(self, tokens: int) -> None:
        """Replace the estimate by the actual usage."""
        self.link.tell("used", self.number, tokens)


@dataclass(frozen=True, slots=True)
class RemoteRateLimit:
    """See Limiter: that of the coordinator, so that the limits hold over all workers."""

    link: Link
    name: str

    async def acquire(self, tokens: int, *, order: int = 0) -> RemotePermit:
        """Wait for a turn."""
        return RemotePermit(await self.link.ask("turn", self.name, tokens, order), self.link)

    def pause(self, seconds: float) -> None:
        """All calls of all workers wait."""
        self.link.tell("pause", self.name, seconds)


class UnlimitedRate(Limiter):
    """Turns of a model without limits need no question; a pause holds for all workers."""

    def __init__(self, link: Link, name: str) -> None:
        super().__init__()
        self._link = link
        self._name = name

    def pause(self, seconds: float) -> None:
        """All calls of all workers wait."""
        self.hold(seconds)
        self._link.tell("pause", self._name, seconds)

    def hold(self, seconds: float) -> None:
        """Another worker was asked to wait."""
        super().pause(seconds)


@dataclass(frozen=True, slots=True)
class RemoteAttempt:
    """See PaidAttempt: the one that the coordinator holds under this number."""

    link: Link
    cache: WorkerCache
    number: int
    aside_usd: float

    async def begin(self, attempts: Sequence[Attempt]) -> None:
        """The attempt is sent now."""
        await self.link.ask("begin", self.number, attempts)

    async def settle(self, attempts: Sequence[Attempt]) -> None:
        """The attempt brought no answer."""
        await self.link.ask("settle", self.number, attempts)

    async def keep(self, entry: Entry) -> Entry:
        """Keep the answer, and what it cost."""
        return await self.cache.put_paid(entry, self.number)


class RemoteBudget:
    """See Budget: that of the coordinator, so that the cap holds over all workers."""

    def __init__(self, link: Link, cache: WorkerCache) -> None:
        self._link = link
        self._cache = cache
        self._numbers = itertools.count()

    async def admit(self, trial: int) -> None:
        """Wait for a trial's allowance."""
        await self._link.ask("admit", trial)

    def leave(self, trial: int) -> None:
        """The trial has ended or is suspended."""
        self._link.tell("leave", trial)

    @asynccontextmanager
    async def attempt(self, trial: int, key: str, asked: Asked) -> AsyncIterator[RemoteAttempt]:
        """The money of one attempt, which the coordinator sets aside and holds.

        It is told of the end in any case: who gives up waiting cannot know whether the money was
        set aside meanwhile, its answer being under way.
        """
        number = next(self._numbers)
        try:
            aside_usd = await self._link.ask("set_aside", number, trial, key, asked)
            yield RemoteAttempt(self._link, self._cache, number, aside_usd)
        finally:
            self._link.tell("close", number)


@dataclass(frozen=True, slots=True)
class RemoteServices:
    """See SharedServices."""

    limiters: Mapping[str, RateLimitPort]
    budget: RemoteBudget
    claims: RemoteClaims
