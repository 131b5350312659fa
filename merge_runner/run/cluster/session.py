"""A worker's batch as the coordinator sees it: what it holds, and gives back when it is gone."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

from distributed.comm import Comm

from merge_runner.errors import CacheFailed, TrialSuspended
from merge_runner.llm.budget import PaidAttempt
from merge_runner.llm.cache import CachedCall, KnownCall
from merge_runner.llm.call import Wait
from merge_runner.llm.ledger import Asked
from merge_runner.llm.meter import Meter
from merge_runner.llm.shared_services import Settle
from merge_runner.records import TrialRecord, TrialSpec
from merge_runner.run.cluster.batch import Batch
from merge_runner.run.cluster.link import Link, rebuilt

if TYPE_CHECKING:
    from merge_runner.run.cluster.coordinator import Coordinator

# Replies that a dead worker had sent are still stored, and what it paid for is booked; whatever it
# waited for is given up.
SURVIVES_DISCONNECT = frozenset({"keep", "unanswered", "settle", "begin", "end"})


class Session:
    """One batch at one worker.

    ``trials`` are those it holds, by their order in the sweep; ``ended`` is True once the worker
    has said that the batch has ended.
    """

    def __init__(self, coordinator: Coordinator, comm: Comm) -> None:
        self.trials: dict[int, TrialSpec] = {}
        self.in_flight = 0
        self.running = 0
        self.in_flight_calls = 0
        self.waits: Sequence[Wait] = ()
        self.worker = ""
        self._run = coordinator
        self._budget = coordinator.services.budget
        self._limiters = coordinator.services.limiters
        self._cache = coordinator.cache
        self._claimed: set[str] = set()
        self._turns: dict[int, Settle] = {}
        self._numbers = itertools.count()
        self._attempts: dict[int, PaidAttempt] = {}
        self.ended = False
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
                "pause": lambda name, seconds: self._limiters[name].pause(seconds),
                "admit": self._budget.admit,
                "leave": self._budget.leave,
                "set_aside": self._set_aside,
                "begin": lambda number, attempts: self._attempts[number].begin(attempts),
                "settle": lambda number, attempts: self._attempts[number].settle(attempts),
                "close": self._close,
            },
            survives_disconnect=SURVIVES_DISCONNECT,
        )

    async def serve(self) -> None:
        """Serve the worker until it hangs up, then give back whatever it held."""
        try:
            await self.link.serve()
        finally:
            for key in self._claimed.copy():
                self._release(key)
            # What was sent stays aside in the ledger; see PaidAttempt.
            for number in list(self._attempts):
                self._close(number)
            self._budget.readmit(self.trials)

    async def _join(self, token: str, fingerprint: str, worker: str, host: str) -> Batch | None:
        self.worker = worker
        return await self._run.admit(self, token, fingerprint, host)

    def _trial(self, order: int, told: TrialRecord | str) -> None:
        """A trial has ended: takes its record, or the reason why it is suspended."""
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

    async def _claim(self, key: str) -> KnownCall | None:
        known = await self._cache.claim(key)
        if known is not None:
            self._claimed.add(key)
        return known

    def _release(self, key: str) -> None:
        self._claimed.remove(key)
        self._cache.release(key)

    async def _keep(self, entry: CachedCall, paid: int | None) -> CachedCall | None:
        """Store a reply and the attempt's cost; returns another reply if one was there before."""
        keep = self._cache.put if paid is None else self._attempts[paid].keep
        try:
            kept = await keep(entry)
        except CacheFailed as exc:
            self._run.fail(exc)  # reported here, not by the worker, since the cache is ours
            raise
        self._run.answered[entry.request.model] += 1
        return None if kept == entry else kept

    async def _turn(self, name: str, tokens: int, order: int) -> int:
        settle = await self._limiters[name].acquire(tokens, order=order)
        number = next(self._numbers)
        self._turns[number] = settle
        return number

    def _used(self, number: int, tokens: int) -> None:
        self._turns.pop(number)(tokens)

    async def _set_aside(self, number: int, trial: int, key: str, asked: Asked) -> float:
        """Set money aside for an attempt, and hold it under a number that the worker chose."""
        paid = await self._budget.set_aside(trial, key, asked)
        self._attempts[number] = paid
        return paid.aside_usd

    def _close(self, number: int) -> None:
        """An attempt has ended; if its worker gave up waiting for money, nothing is held for it."""
        if paid := self._attempts.pop(number, None):
            paid.close()
