"""A cap in USD that holds over all runs of a sweep, and money that finishes trials.

The worst case of an attempt is reserved when it queues for its turn, and durably right before it is
sent; see PaidAttempt.

So that money finishes trials instead of beginning ever more of them, a trial begins only where what
it is expected to cost fits beside what the trials that have begun are still expected to cost.
Expectations err, so an attempt leaves room for what older trials need, and for no younger one's:
the oldest trial is suspended only where all the money left does not pay for a single attempt.

A server may ignore the output cap. Several attempts are in flight only while twice their worst
cases fit, so that one reply at most, the last one, can pass the cap.
"""

from __future__ import annotations

import asyncio
import bisect
import math
from asyncio import Future
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from operator import itemgetter

from merge_runner.errors import TrialSuspended
from merge_runner.llm.cache import both
from merge_runner.llm.durable import Execute, ResultT
from merge_runner.llm.ledger import TOLERANCE_USD, Asked, Ledger
from merge_runner.records import Attempt

# An older trial that has money kept for it may wait for a call of a younger one, which waits for
# money: after this long, with nothing in flight, it is no longer counted on.
PATIENCE_S = 90.0
USED_UP = "others under the same cap have used it up"


@dataclass(slots=True)
class PaidAttempt:
    """The money of one attempt, from its reservation to ``close``, the end of the attempt.

    ``aside_usd`` is reserved in this process while it is ``queued``, and from ``begin`` on in the
    ledger. An attempt that ends before ``begin`` (cancelled while waiting, refused by the cap)
    gives all of it back to its trial. After ``settle`` it gives back what was not
    spent, where the cost is known. Otherwise it may have been charged: all of it stays in the
    ledger until a user releases it.
    """

    budget: Budget
    trial: int
    key: str
    asked: Asked
    aside_usd: float
    queued: bool = True
    cost_usd: float | None = None

    def __post_init__(self) -> None:
        self.budget.in_flight += 1
        self.budget.queued_usd += self.aside_usd if self.queued else 0.0
        self.budget.charge(self.trial, self.aside_usd)

    async def ask(self) -> None:
        """Wait for whoever shares the cap out, as a cluster's coordinator; raises TrialSuspended.

        Nothing is sent or durable here yet, so that this can be given up.
        """
        if self.queued and not await self.budget.ledger.ask(self.key, self.aside_usd, self.asked):
            raise TrialSuspended(USED_UP)

    async def begin(self, number: int) -> None:
        """Make the reservation durable, since the attempt is sent now; raises TrialSuspended."""
        if not self.queued:  # in a smaller batch than before, or in one of an earlier run
            return
        ledger, cap_usd = self.budget.ledger, self.budget.cap_usd
        worst = (self.key, number, self.aside_usd, cap_usd, self.asked)
        if ledger.scope and not await ledger.store.write(partial(ledger.reserve, *worst)):
            raise TrialSuspended(USED_UP)
        self.queued = False
        self.budget.queued_usd -= self.aside_usd

    def settle(self, attempt: Attempt, keep: Callable[[Execute], ResultT]) -> Future[ResultT]:
        """Keep what the attempt brought, and settle what it cost, in one durable transaction."""
        self.cost_usd, ledger = attempt.cost_usd, self.budget.ledger
        settle = partial(ledger.settle, self.key, attempt, self.asked.driver)
        return ledger.store.write(partial(both, keep, settle))

    def close(self) -> None:
        """Give back what the attempt, which has ended, did not spend."""
        self.budget.in_flight -= 1
        if self.queued:
            self.budget.queued_usd -= self.aside_usd
            self.cost_usd = 0.0
        if self.budget.ledger.is_shared_out:
            self.budget.ledger.ended(self.key, self.cost_usd)
        if self.cost_usd is not None:
            self.budget.charge(self.trial, self.cost_usd - self.aside_usd)
        self.budget.wake()


class Budget:
    """Spending under a cap in USD; without one nothing is refused, and all of it recorded.

    A trial is named by its order in the sweep; ``trial_usd`` returns the USD that one is expected
    to cost. ``in_flight`` counts the attempts that have money, ``queued_usd`` is reserved in this
    process alone. ``charged_usd`` is by trial that has begun, with reservations.
    """

    def __init__(
        self,
        ledger: Ledger,
        cap_usd: float | None = None,
        trial_usd: Callable[[int], float] = lambda _: 0.0,
    ) -> None:
        self.ledger = ledger
        self.cap_usd = cap_usd
        self.trial_usd = trial_usd
        self.in_flight = 0
        self.queued_usd = 0.0
        self._largest_usd = 0.0
        self._spent_before = ledger.spending.committed_usd > 0
        self.charged_usd: dict[int, float] = {}
        self._left: set[int] = set()
        # The lowest place first: attempts come before trials that wait to begin, and older trials,
        # of a lower order, before younger ones.
        self._queue: list[tuple[tuple[bool, int], asyncio.Event]] = []

    @property
    def waiting(self) -> set[int]:
        """The trials that wait for money, to begin or for an attempt."""
        return {trial for (_, trial), _ in self._queue}

    async def admit(self, trial: int) -> None:
        """Wait until a trial may begin; raises TrialSuspended when no trial's end can let it."""
        if self.cap_usd is not None and trial not in self.charged_usd:
            await self._in_turn((True, trial), lambda _: self._begins(trial))

    def begin_anew(self, trial: int) -> None:
        """Admit a trial at once: it goes on where an earlier run has asked for it."""
        if self.cap_usd is not None and trial not in self._left:
            self.charged_usd.setdefault(trial, 0.0)

    def leave(self, trial: int) -> None:
        """Free the money of a trial that has ended or is suspended."""
        self._left.add(trial)
        if self.charged_usd.pop(trial, None) is not None:
            self.wake()

    async def set_aside(self, trial: int, key: str, asked: Asked) -> PaidAttempt:
        """Reserve an attempt's worst case, more where its server ignores the output cap.

        Waits while other attempts or older trials may free money, then raises TrialSuspended. The
        caller closes what is returned.
        """
        usd = self._worst_usd(asked)
        if self.cap_usd is not None and (self._queue or not self._pays(trial, usd, 0.0)):
            pays = partial(self._pays, trial)
            await self._in_turn((False, trial), lambda s: pays(self._worst_usd(asked), s))
            usd = self._worst_usd(asked)
        self._largest_usd = max(self._largest_usd, usd)
        return PaidAttempt(self, trial, key, asked, usd)

    def going_on(self, trial: int, key: str, asked: Asked) -> PaidAttempt:
        """Return the money of an attempt that an earlier run, perhaps another sweep, has begun."""
        aside_usd = self.ledger.reserved_usd(key)
        return PaidAttempt(self, trial, key, asked, aside_usd, queued=False)

    def charge(self, trial: int, usd: float) -> None:
        """Count what a trial that has begun spends or sets aside, or gives back."""
        if trial in self.charged_usd:
            self.charged_usd[trial] += usd

    def wake(self) -> None:
        """Let the first in the queue see whether it may go on by now."""
        if self._queue:
            self._queue[0][1].set()

    def _begins(self, trial: int) -> bool:
        """Begin a trial if there is money for it beside all that have begun."""
        if trial in self._left:
            raise TrialSuspended("its trial is suspended")
        if trial in self.charged_usd:  # its other driver stood in the queue, too
            return True
        needed_usd, left_usd = self.trial_usd(trial), self._left_usd()
        if left_usd < needed_usd and not self.charged_usd and not self.in_flight:
            # The first one that asks begins all the same: it may cost less, and each attempt must
            # still fit.
            if self._spent_before or self._largest_usd:
                raise self._suspended(f"a whole trial may cost {needed_usd:.2f} USD")
        elif left_usd < needed_usd + self._needed_usd():
            return False
        self.charged_usd[trial] = 0.0
        return True

    def _pays(self, trial: int, worst_usd: float, waited_s: float) -> bool:
        """Return whether there is money for an attempt."""
        left_usd = self._left_usd()
        if left_usd < worst_usd and not self.in_flight:
            raise self._suspended(f"the next call may cost {worst_usd:.4f} USD")
        counted_on = self.in_flight or waited_s < PATIENCE_S
        older_usd = self._needed_usd(before=trial) if counted_on else 0.0
        # A server that ignores the output cap is known only by its first expensive reply, when the
        # others are sent already: all in flight may cost twice as much.
        twice_usd = (self.in_flight + 1) * max(worst_usd, self._largest_usd)
        return left_usd - worst_usd >= max(older_usd, twice_usd if self.in_flight else 0.0)

    def _worst_usd(self, asked: Asked) -> float:
        """Return the worst case, scaled by this driver's largest observed cost overrun."""
        return asked.honest_usd * self.ledger.spending.overruns.get(asked.driver, 1.0)

    def _left_usd(self) -> float:
        assert self.cap_usd is not None
        return self.cap_usd - self.ledger.committed_usd - self.queued_usd + TOLERANCE_USD

    def _needed_usd(self, before: float = math.inf) -> float:
        """Return what the trials that have begun, ``before`` another, are expected to cost yet."""
        needed_usd = 0.0
        for trial, charged_usd in self.charged_usd.items():
            if trial < before:
                needed_usd += max(0.0, self.trial_usd(trial) - charged_usd)
        return needed_usd

    async def _in_turn(self, place: tuple[bool, int], may_go: Callable[[float], bool]) -> None:
        """Wait in the queue until ``may_go``, which is told for how many s this waits, is True."""
        changed, loop = asyncio.Event(), asyncio.get_running_loop()
        own, began_s = (place, changed), loop.time()
        bisect.insort(self._queue, own, key=itemgetter(0))
        try:
            while self._queue[0] is not own or not may_go(loop.time() - began_s):
                changed.clear()
                # For ever it could be that an older trial waits for a call of ours, or that the run
                # of another model, which spends under the same cap, frees money.
                try:
                    async with asyncio.timeout(PATIENCE_S):
                        await changed.wait()
                except TimeoutError:
                    await asyncio.to_thread(self.ledger.read)
        finally:
            self._queue.remove(own)
            self.wake()

    def _suspended(self, what: str) -> TrialSuspended:
        """Return the error of a trial that cannot be paid."""
        spending, kept_usd = self.ledger.read(), self._needed_usd()
        reserved_usd = max(0.0, spending.reserved_usd + self.queued_usd)  # not minus nothing
        elsewhere_usd = self.ledger.committed_usd - spending.committed_usd
        is_elsewhere = elsewhere_usd > TOLERANCE_USD
        elsewhere = f", {elsewhere_usd:.4f} by others under this cap" if is_elsewhere else ""
        total_usd = self.ledger.committed_usd + self.queued_usd
        return TrialSuspended(
            f"{what}, and {total_usd:.4f} of {self.cap_usd:g} USD are "
            f"spent or set aside ({spending.spent_usd:.4f} spent, {reserved_usd:.4f} set aside for "
            f"{spending.open_attempts} attempts whose cost is not known{elsewhere}: "
            "`merge-runner ledger`); "
            f"{kept_usd:.4f} more are kept for the trials that have begun"
        )
