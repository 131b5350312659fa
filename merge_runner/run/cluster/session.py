"""A worker's batch as the coordinator sees it: what it holds, and gives back when it is gone."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

from distributed.comm import Comm

from merge_runner.errors import CacheFailed, RecordingError, TrialSuspended
from merge_runner.llm.cache import Entry
from merge_runner.llm.ledger import Asked
from merge_runner.llm.limiter import Permit
from merge_runner.llm.meter import Meter
from merge_runner.records import Attempt, TrialRecord, TrialSpec
from merge_runner.run.cluster.batch import Batch, Told
from merge_runner.run.cluster.link import Link, rebuilt

if TYPE_CHECKING:
    from merge_runner.run.cluster.coordinator import Coordinator

# What a dead worker had sent is kept, and what it had paid for is booked.
LASTING = frozenset({"keep", "unanswered", "settle", "begin", "end"})


class Session:
    """One batch at one worker.

    ``trials`` are those it holds, by their order in the sweep; ``ended`` that it said so itself.
    """

    def __init__(self, coordinator: Coordinator, comm: Comm) -> None:
        self.trials: dict[int, TrialSpec] = {}
        self.in_flight = 0
        self.running = 0
        self.flying = 0
        self.worker = ""
        self._run = coordinator
        self._desk = coordinator.desk
        self._cache = coordinator.cache
        self._claimed: set[str] = set()
        self._permits: dict[int, Permit] = {}
        self._permit_number = 0
        self._waits: dict[str, set[str]] = {}
        self._open_attempts = 0
        self._queued_usd = 0.0
        self.ended = False
        budget = self._desk.budget
        self.link = Link(
            comm,
            {
                "join": self._join,
                "trial": self._trial,
                "report": self._report,
                "end": self._end,
                "claim": self._claim,
                "release": self._release,
                "keep": self._keep,
                "unanswered": self._cache.put_unanswered,
                "turn": self._turn,
                "used": self._used,
                "pause": self._pause,
                "admit": budget.admit,
                "leave": budget.leave,
                "reserve": self._reserve,
                "begin": self._begin,
                "give_back": self._give_back,
                "settle": budget.ledger.settle,
                "settled": self._settled,
            },
            lasting=LASTING,
        )

    async def serve(self) -> None:
        """Serve the worker until it hangs up; ``ended`` if it said that it had ended."""
        try:
            await self.link.serve()
        finally:
            for key in self._claimed.copy():
                self._release(key)
            self._desk.budget.forsake(
                self.trials, in_flight=self._open_attempts, queued_usd=self._queued_usd
            )
            for name, keys in self._waits.items():
                for key in keys:
                    self._run.meters[name].waits.pop(key, None)

    async def _join(self, token: str, fingerprint: str, worker: str, host: str) -> Batch | None:
        self.worker = worker
        return await self._run.admit(self, token, fingerprint, host)

    def _trial(self, order: int, told: TrialRecord | str) -> None:
        """A trial has ended, or is suspended for the reason that is told."""
        spec = self.trials.pop(order)
        self._run.ended(spec, TrialSuspended(told) if isinstance(told, str) else told)

    def _report(self, since: Mapping[str, Meter], running: int, flying: int) -> None:
        """Add what the worker's clients have counted; their waits replace earlier ones."""
        self.running, self.flying = running, flying
        for name, meter in since.items():
            whole = self._run.meters[name]
            whole.add(meter)
            for key in self._waits.get(name, ()):
                whole.waits.pop(key, None)
            whole.waits.update(meter.waits)
            self._waits[name] = set(meter.waits)

    def _end(self, error: tuple[str, str] | None) -> None:
        self.ended = True
        if error is not None:
            name, text = error
            self._run.fail(rebuilt(name, f"{text} (told by the worker {self.worker})"))

    def _claim(self, key: str) -> Told | None:
        """What is known of a call; None: somebody else is making it, maybe another worker."""
        if key in self._run.claimed or not self._desk.claims.take(key):
            return None
        self._run.claimed.add(key)
        self._claimed.add(key)
        try:
            return Told(self._cache.get(key), self._cache.unanswered(key))
        except RecordingError:
            damaged = tuple(self._cache.set_damage_aside(key))
            return Told(self._cache.get(key), self._cache.unanswered(key), damaged)

    def _release(self, key: str) -> None:
        self._claimed.remove(key)
        self._run.claimed.remove(key)
        self._desk.claims.release(key)

    async def _keep(self, text: str, cost: tuple[float, float | None] | None) -> None:
        """Keep a reply in the main cache; ``cost`` is the worst case and the actual one, in USD."""
        entry = Entry.from_json(text)
        try:
            if cost is None:
                await self._cache.put(entry)
            else:
                await self._desk.budget.ledger.keep(entry, *cost)
        except CacheFailed as exc:
            self._run.fail(exc)
            raise
        self._run.answered[entry.request.model] += 1

    async def _turn(self, name: str, tokens: int, order: int) -> int:
        permit = await self._desk.limiters[name].acquire(tokens, order=order)
        self._permit_number += 1
        self._permits[self._permit_number] = permit
        return self._permit_number

    def _used(self, number: int, tokens: int) -> None:
        self._permits.pop(number).settle(tokens)

    def _pause(self, name: str, seconds: float) -> None:
        self._desk.limiters[name].pause(seconds)
        self._run.tell_pause(self, name, seconds)

    async def _reserve(self, trial: int, worst_usd: float, driver: str) -> float:
        aside_usd = await self._desk.budget.reserve(trial, worst_usd, driver)
        self._open_attempts += 1
        self._queued_usd += aside_usd
        return aside_usd

    async def _begin(
        self, key: str, attempts: list[Attempt], worst_usd: float, asked: Asked
    ) -> None:
        await self._desk.budget.begin(key, attempts, worst_usd, asked)
        self._queued_usd -= worst_usd

    def _give_back(self, trial: int, worst_usd: float) -> None:
        self._open_attempts -= 1
        self._queued_usd -= worst_usd
        self._desk.budget.give_back(trial, worst_usd)

    def _settled(self, trial: int, freed_usd: float) -> None:
        self._open_attempts -= 1
        self._desk.budget.settled(trial, freed_usd)
