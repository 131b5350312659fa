"""A worker's batch as the coordinator sees it: what it holds, and gives back when it is gone."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

from distributed.comm import Comm

from merge_runner.errors import CacheFailed, RecordingError, TrialSuspended
from merge_runner.llm.budget import PaidAttempt
from merge_runner.llm.cache import Entry
from merge_runner.llm.call import Wait
from merge_runner.llm.ledger import Asked
from merge_runner.llm.limiter import Permit
from merge_runner.llm.meter import Meter
from merge_runner.records import Attempt, TrialRecord, TrialSpec
from merge_runner.run.cluster.batch import Batch, KnownCall
from merge_runner.run.cluster.link import Link, rebuilt

if TYPE_CHECKING:
    from merge_runner.run.cluster.coordinator import Coordinator

# What a dead worker had sent is kept, and what it had paid for is booked; whatever it waited for is
# given up.
SURVIVES_DISCONNECT = frozenset({"keep", "unanswered", "settle", "begin", "end"})


class Session:
    """One batch at one worker.

    ``trials`` are those it holds, by their order in the sweep; ``ended`` that it said so itself.
    """

    def __init__(self, coordinator: Coordinator, comm: Comm) -> None:
        self.trials: dict[int, TrialSpec] = {}
        self.in_flight = 0
        self.running = 0
        self.in_flight_calls = 0
        self.waits: Sequence[Wait] = ()
        self.worker = ""
        self._run = coordinator
        self._services = coordinator.services
        self._cache = coordinator.cache
        self._claimed: set[str] = set()
        self._permits: dict[int, Permit] = {}
        self._permit_number = 0
        self._attempts: dict[int, PaidAttempt] = {}
        self.ended = False
        budget = self._services.budget
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
                "set_aside": self._set_aside,
                "begin": self._begin,
                "settle": self._settle,
                "close": self._close,
            },
            survives_disconnect=SURVIVES_DISCONNECT,
        )

    async def serve(self) -> None:
        """Serve the worker until it hangs up; ``ended`` if it said that it had ended."""
        try:
            await self.link.serve()
        finally:
            for key in self._claimed.copy():
                self._release(key)
            # What was sent stays aside in the ledger; see PaidAttempt.
            for number in list(self._attempts):
                self._close(number)
            self._services.budget.readmit(self.trials)

    async def _join(self, token: str, fingerprint: str, worker: str, host: str) -> Batch | None:
        self.worker = worker
        return await self._run.admit(self, token, fingerprint, host)

    def _trial(self, order: int, told: TrialRecord | str) -> None:
        """A trial has ended, or is suspended for the reason that is told."""
        spec = self.trials.pop(order)
        self._run.ended(spec, TrialSuspended(told) if isinstance(told, str) else told)

    def _report(
        self,
        since: Mapping[str, Meter],
        running: int,
        in_flight_calls: int,
        waits: Sequence[Wait],
    ) -> None:
        """Add what the worker's clients have counted, and note what they do now."""
        self.running, self.in_flight_calls, self.waits = running, in_flight_calls, waits
        for name, meter in since.items():
            self._run.meters[name].add(meter)

    def _end(self, error: tuple[str, str] | None) -> None:
        self.ended = True
        if error is not None:
            name, text = error
            self._run.fail(rebuilt(name, f"{text} (told by the worker {self.worker})"))

    def _claim(self, key: str) -> KnownCall | None:
        """What is known of a call; None: somebody else is making it, maybe another worker."""
        if key in self._run.claimed or not self._services.claims.take(key):
            return None
        self._run.claimed.add(key)
        self._claimed.add(key)
        try:
            return KnownCall(self._cache.get(key), self._cache.unanswered(key))
        except RecordingError:
            damaged = tuple(self._cache.set_damage_aside(key))
            return KnownCall(self._cache.get(key), self._cache.unanswered(key), damaged)

    def _release(self, key: str) -> None:
        self._claimed.remove(key)
        self._run.claimed.remove(key)
        self._services.claims.release(key)

    async def _keep(self, text: str, attempt: int | None) -> None:
        """Keep a reply in the main cache; ``attempt`` is the number of the one that paid for it."""
        entry = Entry.from_json(text)
        try:
            if attempt is None:
                await self._cache.put(entry)
            else:
                await self._attempts[attempt].keep(entry)
        except CacheFailed as exc:
            self._run.fail(exc)
            raise
        self._run.answered[entry.request.model] += 1

    async def _turn(self, name: str, tokens: int, order: int) -> int:
        permit = await self._services.limiters[name].acquire(tokens, order=order)
        self._permit_number += 1
        self._permits[self._permit_number] = permit
        return self._permit_number

    def _used(self, number: int, tokens: int) -> None:
        self._permits.pop(number).settle(tokens)

    def _pause(self, name: str, seconds: float) -> None:
        self._services.limiters[name].pause(seconds)
        self._run.tell_pause(self, name, seconds)

    async def _set_aside(self, number: int, trial: int, key: str, asked: Asked) -> float:
        """Set money aside for an attempt, and hold it under a number that the worker chose."""
        paid = await self._services.budget.set_aside(trial, key, asked)
        self._attempts[number] = paid
        return paid.aside_usd

    async def _begin(self, number: int, attempts: Sequence[Attempt]) -> None:
        await self._attempts[number].begin(attempts)

    async def _settle(self, number: int, attempts: Sequence[Attempt]) -> None:
        await self._attempts[number].settle(attempts)

    def _close(self, number: int) -> None:
        """An attempt has ended; nothing is held where its worker gave up waiting for money."""
        if paid := self._attempts.pop(number, None):
            paid.close()
