"""What a worker's clients share with all others: stand-ins that ask the coordinator."""

from __future__ import annotations

import asyncio
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

from merge_runner.errors import RecordingError
from merge_runner.llm.cache import Entry, ResponseCache
from merge_runner.llm.ledger import Asked
from merge_runner.llm.limiter import Limiter
from merge_runner.llm.shared_services import Turns
from merge_runner.llm.write_batcher import Operation
from merge_runner.records import Attempt
from merge_runner.run.cluster.batch import Told
from merge_runner.run.cluster.link import Link


class WorkerCache(ResponseCache):
    """Replies on the worker's own disk, until the coordinator has them.

    What is recorded of a call is known while the call is claimed.
    """

    def __init__(self, folder: Path, link: Link) -> None:
        super().__init__(folder)
        self.told: dict[str, Told] = {}
        self._link = link
        self._sending: dict[str, asyncio.Task[None]] = {}

    def get(self, key: str) -> Entry | None:
        """What the main cache holds, else what a worker that died has left on this disk."""
        told = self.told.get(key)
        if told is None:
            return None
        if told.damaged:
            raise RecordingError("what the main cache held of the call is damaged")
        if told.entry is not None:
            return told.entry
        left = super().get(key)
        if left is not None:
            self._send(left)
        return left

    async def put(self, entry: Entry, also: Operation | None = None) -> Entry:
        """Keep an entry on this disk, and send it on meanwhile."""
        kept = await super().put(entry, also)
        self._send(kept)
        return kept

    async def put_paid(self, entry: Entry, worst_usd: float, actual_usd: float | None) -> Entry:
        """Keep an entry on this disk, then in the main cache, with what it cost."""
        kept = await super().put(entry)
        await self._link.ask("keep", entry.to_json(), (worst_usd, actual_usd))
        await self._discard(entry.request.key)
        return kept

    def set_damage_aside(self, key: str) -> list[str]:
        """What was damaged, there or here."""
        told = self.told[key]
        self.told[key] = replace(told, damaged=())
        return [*told.damaged, *super().set_damage_aside(key)]

    def unanswered(self, key: str) -> tuple[Attempt, ...]:
        """The attempts that the main cache knows."""
        told = self.told.get(key)
        return told.attempts if told else ()

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
        told: Told | None = await self._link.ask("claim", key)
        if told is None:
            return False
        self._cache.told[key] = told
        return True

    def release(self, key: str) -> None:
        """Give a claim up, once the coordinator has the reply."""
        self._cache.told.pop(key, None)
        if sending := self._cache.sending(key):
            sending.add_done_callback(lambda _: self._link.tell("release", key))
        else:
            self._link.tell("release", key)


@dataclass(frozen=True, slots=True)
class RemoteTurn:
    """See Permit."""

    number: int
    link: Link

    def settle(self, tokens: int) -> None:
        """Replace the estimate by the actual usage."""
        self.link.tell("used", self.number, tokens)


@dataclass(frozen=True, slots=True)
class RemoteTurns:
    """See Limiter: that of the coordinator, so that the limits hold over all workers."""

    link: Link
    name: str

    async def acquire(self, tokens: int, *, order: int = 0) -> RemoteTurn:
        """Wait for a turn."""
        return RemoteTurn(await self.link.ask("turn", self.name, tokens, order), self.link)

    def pause(self, seconds: float) -> None:
        """All calls of all workers wait."""
        self.link.tell("pause", self.name, seconds)


class UnlimitedTurns(Limiter):
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
class RemoteLedger:
    """See Ledger: that of the coordinator."""

    link: Link
    cache: WorkerCache

    async def settle(
        self, key: str, attempts: list[Attempt], worst_usd: float, actual_usd: float | None
    ) -> None:
        """An attempt brought no answer."""
        await self.link.ask("settle", key, attempts, worst_usd, actual_usd)

    async def keep(self, entry: Entry, worst_usd: float, actual_usd: float | None) -> Entry:
        """Keep an answered call, and settle its last attempt with it."""
        return await self.cache.put_paid(entry, worst_usd, actual_usd)


@dataclass(frozen=True, slots=True)
class RemoteBudget:
    """See Budget: that of the coordinator, so that the cap holds over all workers."""

    link: Link
    ledger: RemoteLedger

    async def admit(self, trial: int) -> None:
        """Wait for a trial's allowance."""
        await self.link.ask("admit", trial)

    def leave(self, trial: int) -> None:
        """The trial has ended or is suspended."""
        self.link.tell("leave", trial)

    async def reserve(self, trial: int, worst_usd: float, driver: str) -> float:
        """Set an attempt's worst case aside; returns what is set aside."""
        aside_usd: float = await self.link.ask("reserve", trial, worst_usd, driver)
        return aside_usd

    async def begin(
        self, key: str, attempts: list[Attempt], worst_usd: float, asked: Asked
    ) -> None:
        """The attempt is sent now."""
        await self.link.ask("begin", key, attempts, worst_usd, asked)

    def give_back(self, trial: int, worst_usd: float) -> None:
        """The attempt was not begun."""
        self.link.tell("give_back", trial, worst_usd)

    def settled(self, trial: int, freed_usd: float = 0.0) -> None:
        """An attempt has ended."""
        self.link.tell("settled", trial, freed_usd)


@dataclass(frozen=True, slots=True)
class RemoteDesk:
    """See Desk."""

    limiters: Mapping[str, Turns]
    budget: RemoteBudget
    claims: RemoteClaims
