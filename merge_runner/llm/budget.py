"""A cap on what a sweep spends, over all its runs, that holds whatever happens.

The worst case of an attempt is reserved when it queues for its turn, and durably, in the ledger,
right before it is sent. ``async with budget.attempt(...)`` surrounds all that; PaidAttempt says
where the money goes when the attempt ends, however it ends.

So that money finishes trials instead of beginning ever more of them, a trial begins only where what
it is expected to cost (trial_costs.py) fits beside what the trials that have begun are still
expected to cost. Expectations err, so the oldest trial goes first: an attempt leaves room for what
older trials need, and for no younger one's. So the oldest trial has all the money that is left, and
is suspended only where that does not pay for a single attempt.

A server may ignore the output cap. What a reply cost beyond its worst case is taken from what is
left, and from then on the worst case is multiplied by as much as that driver's most expensive reply
exceeded it. Several attempts are in flight only while twice their worst cases fit, so that one
reply at most, the last one, can pass the cap.
"""

from __future__ import annotations

import asyncio
import bisect
import contextlib
from collections.abc import AsyncIterator, Callable, Iterable, Sequence
from contextlib import asynccontextmanager
from dataclasses import dataclass, field
from functools import partial

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
class PaidAttempt:
    """The money of one attempt, from its reservation to the end of the attempt.

    ``aside_usd`` is reserved in this process, and from ``begin`` on in the ledger. An attempt that
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
    cost_usd: float | None = None

    async def begin(self, attempts: Sequence[Attempt]) -> None:
        """Make the reservation durable, since the attempt is sent now; raises TrialSuspended."""
        reserve = partial(self.set_aside, attempts)
        if self.ledger.scope and not await self.ledger.cache.money.writer.write(reserve):
            raise TrialSuspended("another run spends from the same cap, and has used it up")
        self.begun()

    def set_aside(self, attempts: Sequence[Attempt]) -> bool:
        """Do the durable part of ``begin`` in this thread; False if the cap is used up."""
        number, cap_usd = len(attempts) + 1, self.budget.cap_usd
        return not self.ledger.scope or self.ledger.reserve(
            self.key, number, self.aside_usd, cap_usd, self.asked
        )

    def begun(self) -> None:
        """Count the reservation no longer here: ``set_aside`` has made it durable."""
        self.queued = False
        self.budget.queued_usd -= self.aside_usd

    async def settle(self, attempts: Sequence[Attempt]) -> None:
        """Settle the attempt, the last of these, which brought no answer."""
        await self.ledger.settle(self.key, attempts, self.asked)
        self.cost_usd = attempts[-1].cost_usd

    async def keep(self, entry: CachedCall) -> CachedCall:
        """Keep the answer that the attempt brought, then settle what it cost."""
        kept = await self.ledger.keep(entry, self.asked)
        self.cost_usd = entry.attempts[-1].cost_usd
        if self.cost_usd is not None:
            self.budget.costs.learn(self.asked.model, self.cost_usd)
        return kept

    def close(self) -> None:
        """End the attempt."""
        self.budget.end(self)


@dataclass(slots=True, eq=False)
class _Waiting:
    """An entry of a priority queue; the oldest trial, with the lowest order, comes first."""

    trial: int
    changed: asyncio.Event = field(default_factory=asyncio.Event)


class Budget:
    """Spending under a cap in USD; without one nothing is refused, and all of it recorded.

    A trial is named by its order in the sweep. ``in_flight`` counts the attempts that have money,
    ``queued_usd`` is reserved in this process alone.
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
        self._charged_usd: dict[int, float] = {}  # by trial that has begun, with reservations
        self._left: set[int] = set()
        self._trials: list[_Waiting] = []
        self._attempts: list[_Waiting] = []

    async def admit(self, trial: int) -> None:
        """Wait until a trial may begin; raises TrialSuspended when no trial's end can let it."""
        if self.cap_usd is None or trial in self._charged_usd:
            return
        if trial in self._left:
            raise TrialSuspended("its trial is suspended")
        await self._in_queue(self._trials, trial, lambda first, _: self._begins(trial, first))

    def begin_anew(self, trial: int) -> None:
        """Admit a trial at once: it goes on where an earlier run has asked for it."""
        if self.cap_usd is not None and trial not in self._left:
            self._charged_usd.setdefault(trial, 0.0)

    def leave(self, trial: int) -> None:
        """Free the money of a trial that has ended or is suspended."""
        self._left.add(trial)
        if self._charged_usd.pop(trial, None) is not None:
            self._wake()

    @asynccontextmanager
    async def attempt(self, trial: int, key: str, asked: Asked) -> AsyncIterator[PaidAttempt]:
        """Yield the money of one attempt; waits for it as ``set_aside`` does."""
        paid = await self.set_aside(trial, key, asked)
        try:
            yield paid
        finally:
            paid.close()

    async def set_aside(self, trial: int, key: str, asked: Asked) -> PaidAttempt:
        """Reserve an attempt's worst case, more where its server ignores the output cap.

        Waits while other attempts or older trials may free money, then raises TrialSuspended. The
        caller closes what is returned; ``attempt`` does so by itself.
        """
        paid = PaidAttempt(self, self.ledger, trial, key, asked)
        if self.cap_usd is None:
            self._take(paid, self._worst_usd(asked))
        else:
            await self._in_queue(
                self._attempts, trial, lambda first, waited_s: first and self._taken(paid, waited_s)
            )
        return paid

    @asynccontextmanager
    async def going_on(
        self, trial: int, key: str, asked: Asked, scope: str
    ) -> AsyncIterator[PaidAttempt]:
        """Yield the money of an attempt that an earlier run has begun under a ledger's name."""
        ledger = Ledger(self.ledger.cache, scope) if self.ledger.scope else self.ledger
        paid = PaidAttempt(self, ledger, trial, key, asked, ledger.aside_usd(key), queued=False)
        self.in_flight += 1
        self._charge(trial, paid.aside_usd)
        try:
            yield paid
        finally:
            paid.close()

    def end(self, paid: PaidAttempt) -> None:
        """Give back what an attempt that has ended did not spend."""
        self.in_flight -= 1
        if paid.queued:
            self.queued_usd -= paid.aside_usd
            self._charge(paid.trial, -paid.aside_usd)
        elif paid.cost_usd is not None:
            self._charge(paid.trial, paid.cost_usd - paid.aside_usd)
        self._wake()

    def _begins(self, trial: int, first: bool) -> bool:
        """Begin a trial if there is money for it beside all that have begun."""
        if trial in self._charged_usd:  # its other driver stood in the queue, too
            return True
        if not first:
            return False
        needed_usd, spending = self.costs.usd(trial), self.ledger.read()
        left_usd = self._left_usd(spending) - needed_usd + TOLERANCE_USD
        if left_usd < 0 and not self._charged_usd and not self.in_flight:
            if self._spent_before or not self._asked.isdisjoint(self.costs.models(trial)):
                raise self._suspended(f"a whole trial may cost {needed_usd:.2f} USD", spending)
            # The first one of a model shows what a trial costs; each attempt must still fit.
        elif left_usd < self._needed_usd(self._charged_usd):
            return False
        self._charged_usd[trial] = 0.0
        return True

    def _taken(self, paid: PaidAttempt, waited_s: float) -> bool:
        """Take the money for an attempt if there is any."""
        worst_usd, spending = self._worst_usd(paid.asked), self.ledger.read()
        left_usd = self._left_usd(spending) - worst_usd + TOLERANCE_USD
        if left_usd < 0 and not self.in_flight:
            raise self._suspended(f"the next call may cost {worst_usd:.4f} USD", spending)
        counted_on = self.in_flight or waited_s < PATIENCE_S
        older = (trial for trial in self._charged_usd if trial < paid.trial and counted_on)
        # A server that ignores the output cap is known only by its first expensive reply, when the
        # others are sent already: all in flight may cost twice as much.
        twice_usd = (self.in_flight + 1) * max(worst_usd, self._largest_usd)
        if left_usd < max(self._needed_usd(older), twice_usd if self.in_flight else 0.0):
            return False
        self._take(paid, worst_usd)
        return True

    def _take(self, paid: PaidAttempt, usd: float) -> None:
        self.in_flight += 1
        self.queued_usd += usd
        self._largest_usd = max(self._largest_usd, usd)
        self._asked.add(paid.asked.model)
        paid.aside_usd = usd
        self._charge(paid.trial, usd)

    def _charge(self, trial: int, usd: float) -> None:
        if trial in self._charged_usd:
            self._charged_usd[trial] += usd

    def _worst_usd(self, asked: Asked) -> float:
        """Return the worst case, scaled by this driver's largest observed cost overrun."""
        return asked.honest_usd * self.ledger.spending.times(asked.driver)

    def _left_usd(self, spending: Spending) -> float:
        assert self.cap_usd is not None
        return self.cap_usd - spending.committed_usd - self.queued_usd

    def _needed_usd(self, trials: Iterable[int]) -> float:
        """Return what these begun trials are still expected to cost."""
        return sum(max(0.0, self.costs.usd(each) - self._charged_usd[each]) for each in trials)

    async def _in_queue(
        self, queue: list[_Waiting], trial: int, serve: Callable[[bool, float], bool]
    ) -> None:
        """Wait until ``serve`` says True.

        It is told whether this trial is the first in the queue, and how long it has waited, in s.
        """
        own, loop = _Waiting(trial), asyncio.get_running_loop()
        began_s = loop.time()
        bisect.insort(queue, own, key=lambda waiting: waiting.trial)
        try:
            while not serve(queue[0] is own, loop.time() - began_s):
                own.changed.clear()
                # For ever it could be that an older trial waits for a call of ours, or that the run
                # of another model, which spends under the same cap, frees money.
                with contextlib.suppress(TimeoutError):
                    async with asyncio.timeout(PATIENCE_S):
                        await own.changed.wait()
        finally:
            queue.remove(own)
            self._wake()

    def _wake(self) -> None:
        """Wake those who are first in their queues, or may go on anyway."""
        for waiting in (*self._trials[:1], *self._attempts[:1]):
            waiting.changed.set()
        for waiting in self._trials:
            if waiting.trial in self._charged_usd:
                waiting.changed.set()

    def _suspended(self, what: str, spending: Spending) -> TrialSuspended:
        reserved_usd = spending.reserved_usd + self.queued_usd
        kept_usd = self._needed_usd(self._charged_usd)
        return TrialSuspended(
            f"{what}, and {spending.spent_usd + reserved_usd:.4f} of {self.cap_usd:g} USD are "
            f"spent or set aside ({spending.spent_usd:.4f} spent"
            + (
                f", {reserved_usd:.4f} set aside for {spending.open_attempts} attempts whose cost "
                "is not known: `merge-runner ledger`"
                if reserved_usd > TOLERANCE_USD
                else ""
            )
            + ")"
            + (f"; {kept_usd:.4f} more are kept for the trials that have begun" if kept_usd else "")
        )


class Unpaid(Budget):
    """The budget of a model that costs nothing: only replies and attempts are kept."""

    def __init__(self, cache: ResponseCache) -> None:
        super().__init__(Ledger(cache, ""))  # no money is asked of it
