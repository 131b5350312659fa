"""A cap on what a sweep spends, over all its runs, that holds whatever happens.

The worst case of an attempt is set aside when it queues for its turn, and durably, in the ledger,
right before it is sent. ``async with budget.attempt(...)`` surrounds all that; PaidAttempt says
where the money goes when the attempt ends, however it ends.

So that money finishes trials instead of beginning ever more of them, a trial begins only where what
it is expected to cost (trial_costs.py) fits beside what the trials that have begun are still
expected to cost. Expectations err, so the oldest trial goes first: an attempt leaves room for what
older trials need, and for no younger one's. So the oldest trial has all the money that is left, and
is suspended only where that does not pay for a single attempt.

A server may ignore the output cap. What a reply cost beyond its worst case is taken from what is
left, and from then on the worst case is multiplied by as much as that driver's dearest reply
exceeded it. Several attempts are in flight only while twice their worst cases fit, so that one
reply at most, the last one, can pass the cap.
"""

from __future__ import annotations

import asyncio
import bisect
import contextlib
import itertools
from collections.abc import AsyncIterator, Callable, Iterable, Sequence
from contextlib import asynccontextmanager
from dataclasses import dataclass, field

from merge_runner.errors import TrialSuspended
from merge_runner.llm.cache import CachedCall, ResponseCache
from merge_runner.llm.ledger import TOLERANCE_USD, Asked, Ledger, Spending
from merge_runner.llm.trial_costs import TrialCosts
from merge_runner.records import Attempt

# An older trial that has money kept for it may wait for a call of a younger one, which waits for
# money: after this long, with nothing in flight, it is no longer counted on.
PATIENCE_S = 90.0
NOTHING_EXPECTED = TrialCosts(str, {}, {})


@dataclass(slots=True)
class TrialAccount:
    """What a trial that has begun was charged in USD, with what is set aside for its attempts."""

    charged_usd: float = 0.0


@dataclass(slots=True)
class PaidAttempt:
    """The money of one attempt, from being set aside to the end of the attempt.

    ``aside_usd`` is set aside in this process, and from ``begin`` on in the ledger. An attempt that
    ends

    - before ``begin`` (cancelled while waiting, refused by the cap) gives all of it back;
    - after it (it may have been charged) leaves it in the ledger, until a user releases it;
    - after ``settle`` or ``keep`` has what is not spent of it given back by the ledger, where the
      cost is known.

    What it gives back its trial may spend again.
    """

    budget: Budget
    ledger: Ledger
    trial: int
    key: str
    asked: Asked
    aside_usd: float = 0.0
    queued: bool = True
    # That of its trial; a trial that begins anew has another one.
    account: TrialAccount = field(default_factory=TrialAccount)
    _cost_usd: float | None = None

    @property
    def charged_usd(self) -> float:
        """What it takes of the money in the end: its cost, the worst case if that is unknown."""
        if self.queued:
            return 0.0
        return self.aside_usd if self._cost_usd is None else self._cost_usd

    async def begin(self, attempts: Sequence[Attempt]) -> None:
        """The attempt is sent now, after these: what is set aside for it becomes durable."""
        await self.budget.make_durable(self, attempts)

    def set_aside(self, attempts: Sequence[Attempt]) -> bool:
        """An operation on the cache: the durable part of ``begin``; False if the cap is used up."""
        return self.ledger.set_aside(
            self.key, attempts, self.aside_usd, self.budget.cap_usd, self.asked
        )

    def begun(self) -> None:
        """What ``set_aside`` wrote is durable."""
        self.budget.unqueue(self)

    async def settle(self, attempts: Sequence[Attempt]) -> None:
        """The attempt, the last of these, brought no answer; its cost may be unknown."""
        await self.ledger.settle(self.key, attempts, self.aside_usd, self.asked)
        self._cost_usd = attempts[-1].cost_usd

    async def keep(self, entry: CachedCall) -> CachedCall:
        """Keep the answer that the attempt brought, and what it cost, in one transaction."""
        kept = await self.ledger.keep(entry, self.aside_usd, self.asked)
        self._cost_usd = entry.attempts[-1].cost_usd
        if self._cost_usd is not None:
            self.budget.costs.learn(self.trial, self.asked.model, self._cost_usd)
        return kept

    def close(self) -> None:
        """The attempt has ended."""
        self.budget.end(self)


@dataclass(slots=True, eq=False)
class _Place:
    """A place in a line, that of the oldest trial first."""

    trial: int
    number: int
    told: asyncio.Event = field(default_factory=asyncio.Event)


class Budget:
    """Spending under a cap in USD; without one nothing is refused, and all of it recorded.

    A trial is named by its order in the sweep. ``in_flight`` counts the attempts that have money,
    ``queued_usd`` is set aside in this process alone, and ``largest_usd`` is the most that was set
    aside for one attempt.
    """

    def __init__(
        self,
        ledger: Ledger,
        cap_usd: float | None = None,
        costs: TrialCosts = NOTHING_EXPECTED,
    ) -> None:
        self.ledger = ledger
        self.cap_usd = cap_usd
        self.costs = costs
        self.in_flight = 0
        self.queued_usd = 0.0
        self._largest_usd = 0.0
        self._spent_before = ledger.spending.committed_usd > 0
        self._asked: set[str] = set()
        self._begun: dict[int, TrialAccount] = {}
        self._left: set[int] = set()
        self._door: list[_Place] = []
        self._attempts: list[_Place] = []
        self._numbers = itertools.count()

    async def admit(self, trial: int) -> None:
        """Wait until a trial may begin; raises TrialSuspended when no trial's end can let it."""
        if self.cap_usd is None or trial in self._begun:
            return
        if trial in self._left:
            raise TrialSuspended("its trial is suspended")
        await self._in_line(self._door, trial, lambda first, _: self._begins(trial, first))

    def begin_anew(self, trial: int) -> None:
        """The trial goes on where an earlier run has asked for it, so that it waits for nothing."""
        if self.cap_usd is not None and trial not in self._left:
            self._begun.setdefault(trial, TrialAccount())

    def leave(self, trial: int) -> None:
        """The trial has ended or is suspended, and needs no more money."""
        self._left.add(trial)
        if self._begun.pop(trial, None) is not None:
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

        Waits while other attempts or older trials may free money, then raises TrialSuspended. The
        caller closes what is returned; ``attempt`` does so by itself.
        """
        paid = PaidAttempt(self, self.ledger, trial, key, asked)
        if self.cap_usd is None:
            self._take(paid, self._expected_usd(asked))
        else:
            await self._in_line(
                self._attempts, trial, lambda first, waited_s: first and self._taken(paid, waited_s)
            )
        return paid

    @asynccontextmanager
    async def going_on(
        self, trial: int, key: str, asked: Asked, scope: str
    ) -> AsyncIterator[PaidAttempt]:
        """The money of an attempt that an earlier run has begun, under the ledger of this name."""
        ledger = self.ledger.other(scope)
        paid = PaidAttempt(self, ledger, trial, key, asked, ledger.aside_usd(key), queued=False)
        self.in_flight += 1
        paid.account = self._begun.get(trial, paid.account)
        paid.account.charged_usd += paid.aside_usd
        try:
            yield paid
        finally:
            paid.close()

    async def make_durable(self, paid: PaidAttempt, attempts: Sequence[Attempt]) -> None:
        """Move what is set aside for an attempt to the ledger; raises TrialSuspended."""
        if not await self.ledger.reserve(
            paid.key, attempts, paid.aside_usd, self.cap_usd, paid.asked
        ):
            raise TrialSuspended("another run spends from the same cap, and has used it up")
        self.unqueue(paid)

    def end(self, paid: PaidAttempt) -> None:
        """An attempt has ended."""
        self.in_flight -= 1
        paid.account.charged_usd += paid.charged_usd - paid.aside_usd
        if paid.queued:
            self.unqueue(paid)
        self._tell()

    def unqueue(self, paid: PaidAttempt) -> None:
        """What is set aside for an attempt lies in the ledger now, or is given back."""
        paid.queued = False
        self.queued_usd -= paid.aside_usd

    def _begins(self, trial: int, first: bool) -> bool:
        """Whether a trial may begin: there is money for it beside all that have begun."""
        if trial in self._begun:  # its other driver stood in the line, too
            return True
        if not first:
            return False
        needed_usd, spending = self.costs.usd(trial), self.ledger.read()
        left_usd = self._left_usd(spending) - needed_usd + TOLERANCE_USD
        if left_usd < 0 and not self._begun and not self.in_flight:
            if self._spent_before or not self._asked.isdisjoint(self.costs.models(trial)):
                raise self._suspended(f"a whole trial may cost {needed_usd:.2f} USD", spending)
            # The first one of a model shows what a trial costs; each attempt must still fit.
        elif left_usd < self._needed_usd(self._begun):
            return False
        self._begun[trial] = TrialAccount()
        return True

    def _taken(self, paid: PaidAttempt, waited_s: float) -> bool:
        """Whether there is money for an attempt, which is taken."""
        aside_usd, spending = self._expected_usd(paid.asked), self.ledger.read()
        left_usd = self._left_usd(spending) - aside_usd + TOLERANCE_USD
        if left_usd < 0 and not self.in_flight:
            raise self._suspended(f"the next call may cost {aside_usd:.4f} USD", spending)
        counted_on = self.in_flight or waited_s < PATIENCE_S
        older = (trial for trial in self._begun if trial < paid.trial and counted_on)
        if left_usd < max(self._needed_usd(older), self._twice_usd(aside_usd)):
            return False
        self._take(paid, aside_usd)
        return True

    def _take(self, paid: PaidAttempt, aside_usd: float) -> None:
        self.in_flight += 1
        self.queued_usd += aside_usd
        self._largest_usd = max(self._largest_usd, aside_usd)
        self._asked.add(paid.asked.model)
        paid.aside_usd = aside_usd
        paid.account = self._begun.get(paid.trial, paid.account)
        paid.account.charged_usd += aside_usd

    def _expected_usd(self, asked: Asked) -> float:
        """The worst case, as many times as this driver's dearest reply has cost it."""
        return asked.honest_usd * self.ledger.spending.times(asked.driver)

    def _left_usd(self, spending: Spending) -> float:
        """What is neither spent nor set aside."""
        assert self.cap_usd is not None
        return self.cap_usd - spending.committed_usd - self.queued_usd

    def _twice_usd(self, aside_usd: float) -> float:
        """What must be left beside an attempt so that all in flight may cost twice as much."""
        # A server that ignores the output cap is known only by its first dear reply, when the
        # others are sent already.
        return (self.in_flight + 1) * max(aside_usd, self._largest_usd) if self.in_flight else 0.0

    def _needed_usd(self, trials: Iterable[int]) -> float:
        """What these begun trials are still expected to cost."""
        return sum(
            max(0.0, self.costs.usd(trial) - self._begun[trial].charged_usd) for trial in trials
        )

    async def _in_line(
        self, line: list[_Place], trial: int, serve: Callable[[bool, float], bool]
    ) -> None:
        """Wait until ``serve`` says True.

        It is told whether this trial is the first in the line, and how long it has waited, in s.
        """
        place, waited_s = _Place(trial, next(self._numbers)), 0.0
        bisect.insort(line, place, key=lambda each: (each.trial, each.number))
        try:
            while not serve(line[0] is place, waited_s):
                waited_s += await _told(place)
        finally:
            line.remove(place)
            self._tell()

    def _tell(self) -> None:
        """Something has changed for those who are first in their lines, or may go on anyway."""
        for place in (*self._door[:1], *self._attempts[:1]):
            place.told.set()
        for place in self._door:
            if place.trial in self._begun:
                place.told.set()

    def _suspended(self, what: str, spending: Spending) -> TrialSuspended:
        aside_usd = spending.reserved_usd + self.queued_usd
        kept_usd = self._needed_usd(self._begun)
        return TrialSuspended(
            f"{what}, and {spending.spent_usd + aside_usd:.4f} of {self.cap_usd:g} USD are spent "
            f"or set aside ({spending.spent_usd:.4f} spent"
            + (
                f", {aside_usd:.4f} set aside for {spending.open_attempts} attempts whose cost is "
                "not known: `merge-runner ledger`"
                if aside_usd > TOLERANCE_USD
                else ""
            )
            + ")"
            + (f"; {kept_usd:.4f} more are kept for the trials that have begun" if kept_usd else "")
        )


async def _told(place: _Place) -> float:
    """Wait for a change, for a while only; returns for how long in s."""
    # For ever it could be that an older trial waits for a call of ours, or that the run of another
    # model, which spends under the same cap, frees money.
    loop = asyncio.get_running_loop()
    began = loop.time()
    place.told.clear()
    with contextlib.suppress(TimeoutError):
        async with asyncio.timeout(PATIENCE_S):
            await place.told.wait()
    return loop.time() - began


@dataclass(frozen=True, slots=True)
class Unpaid:
    """The budget of a model that costs nothing: only replies and attempts are kept."""

    cache: ResponseCache

    async def admit(self, trial: int) -> None:
        """Every trial may begin."""

    def begin_anew(self, trial: int) -> None:
        """Every trial may begin."""

    def leave(self, trial: int) -> None:
        """No money is kept for the trial."""

    @asynccontextmanager
    async def attempt(self, trial: int, key: str, asked: Asked) -> AsyncIterator[UnpaidAttempt]:
        """Nothing is set aside."""
        yield UnpaidAttempt(self.cache, key)

    @asynccontextmanager
    async def going_on(
        self, trial: int, key: str, asked: Asked, scope: str
    ) -> AsyncIterator[UnpaidAttempt]:
        """Nothing was set aside."""
        yield UnpaidAttempt(self.cache, key)


@dataclass(frozen=True, slots=True)
class UnpaidAttempt:
    """One attempt that costs nothing; see PaidAttempt."""

    cache: ResponseCache
    key: str
    aside_usd: float = 0.0

    async def begin(self, attempts: Sequence[Attempt]) -> None:
        """Nothing is noted: what a process that dies has in flight costs nothing."""

    def set_aside(self, attempts: Sequence[Attempt]) -> bool:
        """There is nothing to set aside."""
        return True

    def begun(self) -> None:
        """See ``set_aside``."""

    async def settle(self, attempts: Sequence[Attempt]) -> None:
        """Keep the attempts for a later run."""
        await self.cache.put_unanswered(self.key, tuple(attempts))

    async def keep(self, entry: CachedCall) -> CachedCall:
        """Keep the answer."""
        return await self.cache.put(entry)
