"""Admission control under a cap: trials are admitted and attempts reserved, oldest trial first.

A trial is admitted if its expected cost, and what the running trials are still expected to cost,
fit under the cap. So money finishes trials instead of beginning more. The first trial is also
admitted if nothing was spent or reserved before it.

The oldest running trial may use all that is left. A younger one leaves what older ones are still
expected to cost. So, if expectations were too low, the youngest are suspended first. If several
trials share a call, the oldest running trial pays, so that a running trial never waits for the
admission of another. A probe comes first and may use all that is left, since older trials may wait
for its reply.

The worst case of an attempt is reserved in this process while it waits for its turn, and in the
ledger right before it is sent. A server may ignore the output cap. So an attempt joins others in
flight only if what is left beyond all reservations covers the largest worst case once more for each
of them. Then replies that exceed their reservations by no more than that stay under the cap; an
attempt that is alone in flight can exceed it.
"""

from __future__ import annotations

import asyncio
import math
from asyncio import Future
from bisect import insort
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
USED_UP = "the cap was used up while the attempt waited, by others under it or by an overrun"


@dataclass(slots=True)
class Reservation:
    """Worst case of one attempt, ``usd``: the constructor reserves it, ``close`` ends it.

    While ``queued`` it is reserved in this process, and after ``begin`` in the ledger. ``close``
    returns money to the trial: ``usd`` if the attempt has not begun, ``usd`` less the cost if the
    cost is booked. If the cost is unknown, the attempt may have been charged: ``usd`` stays in the
    ledger until a user releases it.
    """

    budget: Budget
    trial: int
    key: str
    label: CallLabel
    usd: float
    queued: bool = True
    cost_usd: float | None = None

    def __post_init__(self) -> None:
        self.budget.open_reservations += 1
        self.budget.queued_usd += self.usd if self.queued else 0.0
        self._take(self.usd)

    async def begin(self, number: int) -> None:
        """Reserve in the ledger, right before the attempt is sent.

        Raises TrialSuspended if the cap was used up meanwhile.
        """
        if not self.queued:  # it is reserved: by an earlier run, or for a batch that was refused
            return
        ledger = self.budget.ledger
        reserve = partial(ledger.reserve, self.key, number, self.usd, self.label)
        if ledger.scope and not await ledger.store.write(reserve):
            raise TrialSuspended(USED_UP)
        self.queued = False
        self.budget.queued_usd -= self.usd
        self.budget.queue.wake()

    def book(self, attempt: Attempt, keep: Callable[[Execute], ResultT]) -> Future[ResultT]:
        """Store the attempt's reply and its cost, in one durable transaction."""
        self.cost_usd, ledger = attempt.cost_usd, self.budget.ledger
        book = partial(ledger.book, self.key, attempt, self.label.driver)
        return ledger.store.write(partial(both, keep, book))

    def close(self) -> None:
        """End the attempt: return what it did not spend; nothing where its cost is unknown."""
        self.budget.open_reservations -= 1
        if self.queued:
            self.budget.queued_usd -= self.usd
            self.cost_usd = 0.0
        if self.cost_usd is not None:
            self._take(self.cost_usd - self.usd)
        self.budget.queue.wake()

    def _take(self, usd: float) -> None:
        """Subtract from the expected cost of the trial, if it still runs."""
        if self.trial in self.budget.expected_usd:
            self.budget.expected_usd[self.trial] -= usd


@dataclass(slots=True, eq=False)
class Waiter:
    """Call that waits for money, with the trials that share it: they may change meanwhile."""

    trials: Sequence[int]
    is_admission: bool = False
    is_probe: bool = False
    changed: asyncio.Event = field(default_factory=asyncio.Event)


class MoneyQueue:
    """Priority queue: probes, calls of running trials, trials that wait for admission.

    A call takes the place of the oldest running trial that needs it.
    """

    def __init__(self, ledger: Ledger, expected_usd: Mapping[int, float]) -> None:
        self.waiters: list[Waiter] = []
        self._ledger = ledger
        self._expected_usd = expected_usd

    @property
    def trials(self) -> set[int]:
        """Trials that wait for money, for admission or for an attempt."""
        return {trial for waiter in self.waiters for trial in waiter.trials}

    def _place(self, waiter: Waiter) -> tuple[bool, float]:
        if waiter.is_probe:
            return False, -math.inf
        running = self._expected_usd.keys() & waiter.trials
        return waiter.is_admission and not running, min(running or waiter.trials, default=math.inf)

    def wake(self) -> None:
        """Let the first in the queue check whether it may go on."""
        if self.waiters:
            self.waiters[0].changed.set()

    def reorder(self, trial: int | None = None) -> None:
        """Sort the queue, and wake its first.

        ``trial`` has begun or ended; None: the trials that share a call have changed.
        """
        if trial is None or any(trial in waiter.trials for waiter in self.waiters):
            self.waiters.sort(key=self._place)
        self.wake()

    async def wait(self, waiter: Waiter, may_go: Callable[[], bool]) -> None:
        """Wait in the queue until ``may_go`` is True."""
        insort(self.waiters, waiter, key=self._place)
        try:
            while self.waiters[0] is not waiter or not may_go():
                waiter.changed.clear()
                try:
                    async with asyncio.timeout(READ_EVERY_S):
                        await waiter.changed.wait()
                except TimeoutError:
                    await self._ledger.store.write(self._ledger.refresh)
        finally:
            self.waiters.remove(waiter)
            self.wake()


class Budget:
    """Spending under a ledger's cap; without a cap it is only recorded.

    All models of a run share a budget, also those of unknown price. Only free models share another,
    without a cap. A trial is named by its order in the sweep; ``trial_usd`` returns its expected
    cost. ``open_reservations`` counts reservations, ``queued_usd`` is reserved in this process
    alone. ``expected_usd`` has, by running trial, the rest of its expected cost, below 0 where it
    has cost more.
    """

    def __init__(self, ledger: Ledger, trial_usd: Callable[[int], float] = lambda _: 0.0) -> None:
        self.ledger = ledger
        self.trial_usd = trial_usd
        self.open_reservations = 0
        self.queued_usd = 0.0
        self.expected_usd: dict[int, float] = {}
        self._largest_usd = 0.0
        self._spent_before = ledger.spending.committed_usd > 0
        self._ended: set[int] = set()
        self.queue = MoneyQueue(ledger, self.expected_usd)

    async def admit(self, trials: Sequence[int]) -> None:
        """Wait until one of the trials that share a call runs, or the oldest of them may begin.

        ``trials`` may change meanwhile. Raises TrialSuspended if there is too little money and no
        other trial can free any.
        """
        if self.ledger.cap is not None and self.expected_usd.keys().isdisjoint(trials):
            may_begin = partial(self._may_begin, trials)
            await self.queue.wait(Waiter(trials, is_admission=True), may_begin)
            self.queue.reorder(min(trials))

    def readmit(self, trial: int) -> None:
        """Admit at once a trial whose call an earlier run has sent."""
        if self.ledger.cap is not None and trial not in self._ended:
            self.expected_usd.setdefault(trial, self.trial_usd(trial))
            self.queue.reorder(trial)

    def leave(self, trial: int) -> None:
        """Free the money of a trial that has ended or is suspended."""
        self._ended.add(trial)
        if self.expected_usd.pop(trial, None) is not None:
            self.queue.reorder(trial)

    async def reserve(
        self, trials: Sequence[int], key: str, label: CallLabel, *, is_probe: bool = False
    ) -> Reservation:
        """Reserve an attempt's worst case for the oldest running trial of those that share a call.

        The worst case is scaled if the server ignores the output cap. Waits until there is money
        for it; raises TrialSuspended if there is too little, and no open attempt can free any. The
        caller closes the reservation.
        """
        may_reserve = partial(self._may_reserve, trials, label, is_probe)
        if self.ledger.cap is not None and (self.queue.waiters or not may_reserve()):
            await self.queue.wait(Waiter(trials, is_probe=is_probe), may_reserve)
        usd = self._worst_usd(label)
        self._largest_usd = max(self._largest_usd, usd)
        return Reservation(self, self._payer(trials), key, label, usd)

    def _may_begin(self, trials: Sequence[int]) -> bool:
        """Return whether one of the trials runs; if none does, admit the oldest if its cost fits.

        Raises TrialSuspended if there is too little money and no other trial can free any.
        """
        if not self.expected_usd.keys().isdisjoint(trials):
            return True
        trial = min(trials)
        if trial in self._ended:
            raise TrialSuspended("its trial is suspended")
        needed_usd = self.trial_usd(trial)
        left_usd = self._left_usd(needed_usd)
        if left_usd < needed_usd and not self.expected_usd and not self.open_reservations:
            # The first trial begins all the same: it may cost less, and each attempt must still
            # fit.
            if self._spent_before or self._largest_usd:
                raise self._suspended(f"a whole trial may cost {needed_usd:.2f} USD")
        elif left_usd < needed_usd + self._still_expected_usd():
            return False
        self.expected_usd[trial] = needed_usd
        return True

    def _may_reserve(self, trials: Sequence[int], label: CallLabel, is_probe: bool) -> bool:
        """Return whether an attempt's worst case fits; raise TrialSuspended where it never will."""
        worst_usd = self._worst_usd(label)
        left_usd = self._left_usd(worst_usd)
        if left_usd < worst_usd and not self.open_reservations:
            raise self._suspended(f"the next call may cost {worst_usd:.4f} USD")
        older_usd = 0.0 if is_probe else self._still_expected_usd(before=self._payer(trials))
        # A server that ignores the output cap shows it in its first expensive reply, when others
        # are in flight already: each may cost twice as much.
        twice_usd = (self.open_reservations + 1) * max(worst_usd, self._largest_usd)
        return left_usd - worst_usd >= max(older_usd, twice_usd if self.open_reservations else 0.0)

    def _payer(self, trials: Sequence[int]) -> int:
        """Return the oldest running trial of those that share a call, else the oldest."""
        return min(self.expected_usd.keys() & trials or trials)

    def _worst_usd(self, label: CallLabel) -> float:
        """Return the worst case, scaled by this driver's largest observed cost overrun."""
        return label.worst_usd * self.ledger.spending.overruns.get(label.driver, 1.0)

    def _left_usd(self, needed_usd: float) -> float:
        """Return the USD left under the cap, less what is reserved in this process alone.

        What is spent and reserved is summed anew before a trial is suspended, as other processes
        may have freed money.
        """
        cap, ledger = self.ledger.cap, self.ledger
        assert cap is not None
        if not self.open_reservations and cap.usd - ledger.committed_usd < needed_usd:
            ledger.read()
        return cap.usd - ledger.committed_usd - self.queued_usd + TOLERANCE_USD

    def _still_expected_usd(self, before: float = math.inf) -> float:
        """Return the USD that running trials ``before`` another are still expected to cost."""
        older_usd = 0.0
        for trial, usd in self.expected_usd.items():
            if usd > 0 and trial < before:
                older_usd += usd
        return older_usd

    def _suspended(self, what: str) -> TrialSuspended:
        spending, cap = self.ledger.spending, self.ledger.cap
        assert cap is not None
        reserved_usd = max(0.0, spending.reserved_usd + self.queued_usd)  # never -0.0000
        elsewhere_usd = self.ledger.committed_usd - spending.committed_usd
        is_elsewhere = elsewhere_usd > TOLERANCE_USD
        elsewhere = f", {elsewhere_usd:.4f} by others under this cap" if is_elsewhere else ""
        total_usd = self.ledger.committed_usd + self.queued_usd
        return TrialSuspended(
            f"{what}, and {total_usd:.4f} of {cap.usd:g} USD ({cap.source}) are spent or reserved "
            f"({spending.spent_usd:.4f} spent, {reserved_usd:.4f} reserved for "
            f"{spending.open_attempts} attempts whose cost is not known{elsewhere}: "
            "`merge-runner ledger`); "
            f"{self._still_expected_usd():.4f} more are reserved for the trials that have begun"
        )
