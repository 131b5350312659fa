"""A cap on what a sweep spends, over all its runs, that holds whatever happens.

The worst case of an attempt is set aside when it queues for its turn, and durably, in the ledger,
right before it is sent. ``async with budget.attempt(...)`` surrounds all that; PaidAttempt says
where the money goes when the attempt ends, however it ends.

So that money finishes trials instead of beginning ever more of them, a trial gets an allowance when
it first spends: the worst case of a whole trial. Trials get theirs in the order of the sweep, as
those before them end.

A server may ignore the output cap. What a reply cost beyond its worst case is taken from what is
left, and from then on the worst case is multiplied by as much as that driver's dearest reply
exceeded it. Several attempts are in flight only while twice their worst cases fit, so that one
reply at most, the last one, can pass the cap.
"""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import AsyncIterator, Iterable, Sequence
from contextlib import asynccontextmanager
from dataclasses import dataclass

from merge_runner.errors import TrialSuspended
from merge_runner.llm.cache import CachedCall
from merge_runner.llm.ledger import TOLERANCE_USD, Asked, Ledger
from merge_runner.llm.shared_services import CachePort
from merge_runner.records import Attempt

# A trial of ours that could free money may wait for another process that waits for us: after this
# long it is no longer counted on.
PATIENCE_S = 90.0


@dataclass(slots=True)
class PaidAttempt:
    """The money of one attempt, from being set aside to the end of the attempt.

    ``aside_usd`` is set aside in this process, and from ``begin`` on in the ledger. An attempt that
    ends

    - before ``begin`` (cancelled while waiting, refused by the cap) gives all of it back;
    - after it (it may have been charged) leaves it in the ledger, until a user releases it;
    - after ``settle`` or ``keep`` has what is not spent of it given back by the ledger, where the
      cost is known.
    """

    budget: Budget
    trial: int
    key: str
    asked: Asked
    aside_usd: float
    _queued: bool = True
    _freed_usd: float = 0.0

    async def begin(self, attempts: Sequence[Attempt]) -> None:
        """The attempt is sent now, after these: what is set aside for it becomes durable."""
        await self.budget.make_durable(self, attempts)
        self._queued = False

    async def settle(self, attempts: Sequence[Attempt]) -> None:
        """The attempt, the last of these, brought no answer; its cost may be unknown."""
        await self.budget.ledger.settle(self.key, attempts, self.aside_usd)
        if attempts[-1].cost_usd == 0:
            self._freed_usd = self.aside_usd  # the trial needs it again

    async def keep(self, entry: CachedCall) -> CachedCall:
        """Keep the answer that the attempt brought, and what it cost, in one transaction."""
        return await self.budget.ledger.keep(entry, self.aside_usd)

    def close(self) -> None:
        """The attempt has ended."""
        queued_usd = self.aside_usd if self._queued else 0.0
        freed_usd = queued_usd or self._freed_usd
        self.budget.give_back(self.trial, queued_usd=queued_usd, freed_usd=freed_usd)


class Budget:
    """Spending of one sweep in USD; without a cap nothing is refused, and all of it recorded.

    A trial is named by its order in the sweep.
    """

    def __init__(
        self, ledger: Ledger, *, cap_usd: float | None = None, trial_usd: float = 0.0
    ) -> None:
        """``trial_usd`` is the worst case of a whole trial."""
        self.ledger = ledger
        self.cap_usd = cap_usd
        self._trial_usd = trial_usd
        self._allowances: dict[int, float] = {}
        self._at_the_door: list[int] = []  # once for each side that asks
        self._stuck: set[int] = set()
        self._left: set[int] = set()
        self._in_flight = 0
        self._largest_usd = 0.0
        self._queued_usd = 0.0
        self._changed = asyncio.Event()

    async def admit(self, trial: int) -> None:
        """Wait for a trial's allowance; raises TrialSuspended when no trial's end can free it."""
        if self.cap_usd is None:
            return
        if trial in self._left:
            raise TrialSuspended("its trial is suspended")
        self._at_the_door.append(trial)
        try:
            # The oldest trial first: if younger ones were let by, it might wait for ever.
            while trial not in self._allowances:
                allowed = sum(self._allowances.values())
                fits = (
                    self._committed_usd + allowed + self._trial_usd <= self.cap_usd + TOLERANCE_USD
                )
                if fits and trial == min(self._at_the_door):
                    self._allowances[trial] = self._trial_usd
                elif not fits and not self._allowances and not self._in_flight:
                    raise self._suspended(f"a whole trial may cost {self._trial_usd:.2f} USD")
                else:
                    await self._changed.wait()
        finally:
            self._at_the_door.remove(trial)
            self._tell()

    def leave(self, trial: int) -> None:
        """The trial has ended or is suspended: what is left of its allowance is free."""
        self._left.add(trial)
        if self._allowances.pop(trial, None) is not None:
            self._tell()

    def readmit(self, trials: Iterable[int]) -> None:
        """The worker that played these trials is gone, and they may be admitted anew."""
        for trial in trials:
            self._allowances.pop(trial, None)
            self._left.discard(trial)
        self._tell()

    @asynccontextmanager
    async def attempt(self, trial: int, key: str, asked: Asked) -> AsyncIterator[PaidAttempt]:
        """The money of one attempt; waits for it as ``set_aside`` does."""
        paid = await self.set_aside(trial, key, asked)
        try:
            yield paid
        finally:
            paid.close()

    async def set_aside(self, trial: int, key: str, asked: Asked) -> PaidAttempt:
        """Set an attempt's worst case aside, more where its server ignores the output cap.

        Waits while other attempts or trials may free money, then raises TrialSuspended. The caller
        closes what is returned; ``attempt`` does so by itself.
        """
        waited_s = 0.0
        while not self._taken(trial, aside_usd := self._expected_usd(asked)):
            self._stuck.add(trial)
            try:
                # Nothing in flight can free money any more, and each trial that could is stuck.
                if not self._in_flight and (
                    self._allowances.keys() <= self._stuck or waited_s >= PATIENCE_S
                ):
                    raise self._suspended(f"the next call may cost {aside_usd:.4f} USD")
                waited_s += await self._change()
            finally:
                self._stuck.discard(trial)
        self._in_flight += 1
        self._largest_usd = max(self._largest_usd, aside_usd)
        self._queued_usd += aside_usd
        return PaidAttempt(self, trial, key, asked, aside_usd)

    async def make_durable(self, paid: PaidAttempt, attempts: Sequence[Attempt]) -> None:
        """Move what is set aside for an attempt to the ledger; raises TrialSuspended."""
        if not await self.ledger.reserve(
            paid.key, attempts, paid.aside_usd, self.cap_usd, paid.asked
        ):
            raise self._suspended("another run of the sweep spends from the same cap")
        self._queued_usd -= paid.aside_usd

    def give_back(self, trial: int, *, queued_usd: float, freed_usd: float) -> None:
        """An attempt has ended: ``queued_usd`` was set aside for it in this process alone.

        ``freed_usd`` of the trial's allowance was not spent.
        """
        self._in_flight -= 1
        self._queued_usd -= queued_usd
        if trial in self._allowances:
            self._allowances[trial] = min(self._trial_usd, self._allowances[trial] + freed_usd)
        self._tell()

    def _expected_usd(self, asked: Asked) -> float:
        """The worst case, as many times as this driver's dearest reply has cost it."""
        return asked.honest_usd * self.ledger.spending.times(asked.driver)

    @property
    def _committed_usd(self) -> float:
        return self.ledger.read().committed_usd + self._queued_usd

    def _taken(self, trial: int, worst_usd: float) -> bool:
        """Whether there is money for an attempt; taken from the trial's allowance if it lasts."""
        if self.cap_usd is None:
            return True
        own = min(worst_usd, self._allowances.get(trial, 0.0))
        # Beside this attempt there must be room for the rest of all allowances, and, where several
        # are in flight, for each of them to cost twice its worst case: a server that ignores the
        # output cap is known only by its first dear reply, when the others are sent already.
        others = self._in_flight + 1 if self._in_flight else 0
        spare_usd = max(
            sum(self._allowances.values()) - own, others * max(worst_usd, self._largest_usd)
        )
        if self._committed_usd + worst_usd + spare_usd > self.cap_usd + TOLERANCE_USD:
            return False
        if own:
            self._allowances[trial] -= own
        return True

    async def _change(self) -> float:
        """Wait for a change, for a while only; returns for how long in s."""
        # For ever it could be that another process holds a claim that a trial of ours waits for,
        # and waits for one of ours.
        loop = asyncio.get_running_loop()
        began = loop.time()
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(PATIENCE_S):
                await self._changed.wait()
        return loop.time() - began

    def _tell(self) -> None:
        # A new event for the next change: whoever waits for that must not see this one again.
        self._changed.set()
        self._changed = asyncio.Event()

    def _suspended(self, what: str) -> TrialSuspended:
        spending, allowed = self.ledger.spending, sum(self._allowances.values())
        aside = spending.reserved_usd + self._queued_usd
        return TrialSuspended(
            f"{what}, and {self._committed_usd:.4f} of {self.cap_usd:g} USD are spent or set aside "
            f"({spending.spent_usd:.4f} spent"
            + (
                f", {aside:.4f} set aside for {spending.open_attempts} attempts whose cost is not "
                "known: `merge-runner ledger`"
                if aside > TOLERANCE_USD
                else ""
            )
            + ")"
            + (f"; {allowed:.4f} more are kept for the trials that have begun" if allowed else "")
        )


@dataclass(frozen=True, slots=True)
class Unpaid:
    """The budget of a model that costs nothing: only replies and attempts are kept."""

    cache: CachePort

    async def admit(self, trial: int) -> None:
        """Every trial may begin."""

    def leave(self, trial: int) -> None:
        """The trial has no allowance."""

    @asynccontextmanager
    async def attempt(self, trial: int, key: str, asked: Asked) -> AsyncIterator[UnpaidAttempt]:
        """Nothing is set aside."""
        yield UnpaidAttempt(self.cache, key)


@dataclass(frozen=True, slots=True)
class UnpaidAttempt:
    """One attempt that costs nothing; see PaidAttempt."""

    cache: CachePort
    key: str
    aside_usd: float = 0.0

    async def begin(self, attempts: Sequence[Attempt]) -> None:
        """Nothing is noted: what a process that dies has in flight costs nothing."""

    async def settle(self, attempts: Sequence[Attempt]) -> None:
        """Keep the attempts for a later run."""
        await self.cache.put_unanswered(self.key, tuple(attempts))

    async def keep(self, entry: CachedCall) -> CachedCall:
        """Keep the answer."""
        return await self.cache.put(entry)
