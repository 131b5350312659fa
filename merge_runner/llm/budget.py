"""Admission control under a cap: trials are admitted and attempts reserved in their order.

A trial is admitted only if its expected cost, and what the running trials are still expected to
cost, fit under the cap. So money finishes trials instead of beginning more. Expectations err, so
an attempt leaves room only for older trials: the oldest trial is suspended only where the money
left does not pay for a single attempt. A call that several trials share is paid by the oldest
running one, so that a running trial never waits for the admission of another.

The worst case of an attempt is reserved in this process while it waits for its turn, and in the
ledger right before it is sent. A server may ignore the output cap. So several attempts are in
flight only while twice their worst cases fit, and one reply at most, the last, can pass the cap.
"""

from __future__ import annotations

import asyncio
import math
from asyncio import Future
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial

from merge_runner.errors import TrialSuspended
from merge_runner.llm.durable import Execute, ResultT
from merge_runner.llm.ledger import TOLERANCE_USD, CallLabel, Ledger
from merge_runner.llm.store import both
from merge_runner.records import Attempt

# A run of another model, in another process under the same cap, may free money.
READ_EVERY_S = 90.0
USED_UP = "others under the same cap have used it up"


@dataclass(slots=True)
class Reservation:
    """Worst case of one attempt, from its reservation to ``close``, the end of the attempt.

    While ``queued``, ``usd`` is reserved in this process, and after ``begin`` in the ledger. An
    attempt that ends before ``begin`` returns all of it to its trial. After ``settle`` the
    difference to the cost is returned. Where the cost is unknown the attempt may have been charged:
    all of it stays in the ledger until a user releases it.
    """

    budget: Budget
    trial: int
    key: str
    label: CallLabel
    usd: float
    queued: bool = True
    cost_usd: float | None = None

    def __post_init__(self) -> None:
        self.budget.in_flight += 1
        self.budget.queued_usd += self.usd if self.queued else 0.0
        self._charge(self.usd)

    @classmethod
    def resume(cls, budget: Budget, trial: int, key: str, label: CallLabel) -> Reservation:
        """Return the reservation of an attempt that an earlier run, of any sweep, has begun."""
        return cls(budget, trial, key, label, budget.ledger.reserved_usd(key), queued=False)

    async def ask_coordinator(self) -> None:
        """Wait until the coordinator has reserved the attempt; raise TrialSuspended.

        Nothing is sent or durable here yet, so the wait can be cancelled.
        """
        if not await self.budget.ledger.ask_coordinator(self.key, self.usd, self.label):
            raise TrialSuspended(USED_UP)

    async def begin(self, number: int) -> None:
        """Reserve durably, right before the attempt is sent; raise TrialSuspended."""
        if not self.queued:  # it is reserved: by an earlier run, or for a batch that was refused
            return
        ledger = self.budget.ledger
        reserve = partial(ledger.reserve, self.key, number, self.usd, self.label)
        if ledger.scope and not await ledger.store.write(reserve):
            raise TrialSuspended(USED_UP)
        self.queued = False
        self.budget.queued_usd -= self.usd
        self.budget.queue.wake()

    def settle(self, attempt: Attempt, keep: Callable[[Execute], ResultT]) -> Future[ResultT]:
        """Keep what the attempt brought and book its cost, in one durable transaction."""
        self.cost_usd, ledger = attempt.cost_usd, self.budget.ledger
        settle = partial(ledger.settle, self.key, attempt, self.label.driver)
        return ledger.store.write(partial(both, keep, settle))

    def close(self) -> None:
        """Return what the attempt, which has ended, did not spend."""
        self.budget.in_flight -= 1
        if self.queued:
            self.budget.queued_usd -= self.usd
            self.cost_usd = 0.0
        if self.budget.ledger.is_shared_out:
            self.budget.ledger.report_cost(self.key, self.cost_usd)
        if self.cost_usd is not None:
            self._charge(self.cost_usd - self.usd)
        self.budget.queue.wake()

    def _charge(self, usd: float) -> None:
        """Add to what the trial, if it still runs, has spent and reserved."""
        if self.trial in self.budget.charged_usd:
            self.budget.charged_usd[self.trial] += usd


@dataclass(slots=True, eq=False)
class Waiter:
    """Call that waits for money, with the trials that share it: they may change meanwhile."""

    trials: Sequence[int]
    is_admission: bool
    changed: asyncio.Event = field(default_factory=asyncio.Event)


class MoneyQueue:
    """Priority queue: calls of ``running`` trials before trials that wait for admission.

    A call of a running trial has the place of the oldest one, whatever it waits for.
    """

    def __init__(self, ledger: Ledger, running: Mapping[int, float]) -> None:
        self.waiters: list[Waiter] = []
        self._ledger = ledger
        self._running = running

    def place(self, waiter: Waiter) -> tuple[bool, float]:
        """Return the place of a waiter; the lowest is first."""
        running = self._running.keys() & waiter.trials
        return waiter.is_admission and not running, min(running or waiter.trials, default=math.inf)

    def wake(self) -> None:
        """Let the first in the queue check whether it may go on.

        The order depends on the trials that run, and on those that share a call.
        """
        if self.waiters:
            self.waiters.sort(key=self.place)
            self.waiters[0].changed.set()

    async def wait(self, waiter: Waiter, may_go: Callable[[], bool]) -> None:
        """Wait in the queue until ``may_go`` is True."""
        self.waiters.append(waiter)
        self.waiters.sort(key=self.place)
        try:
            while self.waiters[0] is not waiter or not may_go():
                waiter.changed.clear()
                try:
                    async with asyncio.timeout(READ_EVERY_S):
                        await waiter.changed.wait()
                except TimeoutError:
                    await asyncio.to_thread(self._ledger.read)
        finally:
            self.waiters.remove(waiter)
            self.wake()


class Budget:
    """Spending under the cap of a ledger; without one nothing is refused, and all of it recorded.

    A trial is named by its order in the sweep; ``trial_usd`` returns its expected cost.
    ``in_flight`` counts reservations, ``queued_usd`` is reserved in this process alone.
    ``charged_usd`` has, by running trial, what it has spent and reserved.
    """

    def __init__(self, ledger: Ledger, trial_usd: Callable[[int], float] = lambda _: 0.0) -> None:
        self.ledger = ledger
        self.trial_usd = trial_usd
        self.in_flight = 0
        self.queued_usd = 0.0
        self.charged_usd: dict[int, float] = {}
        self._largest_usd = 0.0
        self._spent_before = ledger.spending.committed_usd > 0
        self._left: set[int] = set()
        self.queue = MoneyQueue(ledger, self.charged_usd)

    @property
    def waiting(self) -> set[int]:
        """Trials that wait for money, for admission or for an attempt."""
        return {trial for waiter in self.queue.waiters for trial in waiter.trials}

    def is_running(self, trials: Sequence[int]) -> bool:
        """Return whether one of the trials is admitted."""
        return not self.charged_usd.keys().isdisjoint(trials)

    async def admit(self, trials: Sequence[int]) -> None:
        """Wait until one of the trials that share a call runs, or the oldest of them may begin.

        ``trials`` may change meanwhile. Raise TrialSuspended if no other trial can free money.
        """
        if self.ledger.cap is not None and not self.is_running(trials):
            await self.queue.wait(
                Waiter(trials, is_admission=True),
                lambda: self.is_running(trials) or self._may_begin(min(trials)),
            )

    def readmit(self, trial: int) -> None:
        """Admit a trial at once: an earlier run has asked for it."""
        if self.ledger.cap is not None and trial not in self._left:
            self.charged_usd.setdefault(trial, 0.0)
            self.queue.wake()

    def leave(self, trial: int) -> None:
        """Free the money of a trial that has ended or is suspended."""
        self._left.add(trial)
        if self.charged_usd.pop(trial, None) is not None:
            self.queue.wake()

    async def reserve(self, trials: Sequence[int], key: str, label: CallLabel) -> Reservation:
        """Reserve an attempt's worst case for the oldest running trial of those that share a call.

        It is scaled where the server ignores the output cap. Waits while other attempts or older
        trials may free money, then raises TrialSuspended. The caller closes the reservation.
        """
        has_cap = self.ledger.cap is not None
        if has_cap and (self.queue.waiters or not self._may_reserve(trials, label)):
            waiter = Waiter(trials, is_admission=False)
            await self.queue.wait(waiter, lambda: self._may_reserve(trials, label))
        usd = self._worst_usd(label)
        self._largest_usd = max(self._largest_usd, usd)
        return Reservation(self, self._payer(trials), key, label, usd)

    def _may_begin(self, trial: int) -> bool:
        """Admit a trial if its expected cost fits beside those running; raise TrialSuspended."""
        if trial in self._left:
            raise TrialSuspended("its trial is suspended")
        needed_usd, left_usd = self.trial_usd(trial), self._left_usd()
        if left_usd < needed_usd and not self.charged_usd and not self.in_flight:
            # The first trial begins all the same: it may cost less, and each attempt must still
            # fit.
            if self._spent_before or self._largest_usd:
                raise self._suspended(f"a whole trial may cost {needed_usd:.2f} USD")
        elif left_usd < needed_usd + self._needed_usd():
            return False
        self.charged_usd[trial] = 0.0
        return True

    def _may_reserve(self, trials: Sequence[int], label: CallLabel) -> bool:
        """Return whether an attempt's worst case fits; raise TrialSuspended where it never will."""
        left_usd, worst_usd = self._left_usd(), self._worst_usd(label)
        if left_usd < worst_usd and not self.in_flight:
            raise self._suspended(f"the next call may cost {worst_usd:.4f} USD")
        older_usd = self._needed_usd(before=self._payer(trials))
        # Only the first expensive reply shows that a server ignores the output cap, when the others
        # are sent already: all in flight may cost twice as much.
        twice_usd = (self.in_flight + 1) * max(worst_usd, self._largest_usd)
        return left_usd - worst_usd >= max(older_usd, twice_usd if self.in_flight else 0.0)

    def _payer(self, trials: Sequence[int]) -> int:
        """Return the oldest running trial of those that share a call, else the oldest."""
        return min(self.charged_usd.keys() & trials or trials)

    def _worst_usd(self, label: CallLabel) -> float:
        """Return the worst case, scaled by this driver's largest observed cost overrun."""
        return label.worst_usd * self.ledger.spending.overruns.get(label.driver, 1.0)

    def _left_usd(self) -> float:
        cap, ledger = self.ledger.cap, self.ledger
        assert cap is not None
        return cap.usd - ledger.committed_usd - self.queued_usd + TOLERANCE_USD

    def _needed_usd(self, before: float = math.inf) -> float:
        """Return the remaining expected cost of the running trials ``before`` another."""
        needed_usd = 0.0
        for trial, charged_usd in self.charged_usd.items():
            if trial < before:
                needed_usd += max(0.0, self.trial_usd(trial) - charged_usd)
        return needed_usd

    def _suspended(self, what: str) -> TrialSuspended:
        """Return the error of a trial for which the money left is too little."""
        spending, expected_usd = self.ledger.read(), self._needed_usd()
        assert self.ledger.cap is not None
        reserved_usd = max(0.0, spending.reserved_usd + self.queued_usd)  # never -0.0000
        elsewhere_usd = self.ledger.committed_usd - spending.committed_usd
        is_elsewhere = elsewhere_usd > TOLERANCE_USD
        elsewhere = f", {elsewhere_usd:.4f} by others under this cap" if is_elsewhere else ""
        total_usd = self.ledger.committed_usd + self.queued_usd
        return TrialSuspended(
            f"{what}, and {total_usd:.4f} of {self.ledger.cap.usd:g} USD are spent or reserved "
            f"({spending.spent_usd:.4f} spent, {reserved_usd:.4f} reserved for "
            f"{spending.open_attempts} attempts whose cost is not known{elsewhere}: "
            "`merge-runner ledger`); "
            f"{expected_usd:.4f} more are kept for the trials that have begun"
        )
