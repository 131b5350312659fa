"""A cap on what a sweep spends, over all its runs, that holds whatever happens.

The worst case of an attempt is set aside when it queues for its turn, and durably, in the ledger,
right before it is sent. So that money ends trials instead of beginning ever more of them, a trial
gets an allowance when it first spends: the worst case of a whole trial. Trials get theirs in the
order of the sweep, as those before them end.

A server may ignore the output cap. What a reply cost more is taken from what is left, and from then
on as many times the worst case is set aside as the dearest reply of that driver has cost. Several
attempts are in flight only while twice their worst cases fit, so that one reply at most, the last
one, can pass the cap.
"""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import Iterable

from merge_runner.errors import TrialSuspended
from merge_runner.llm.ledger import TOLERANCE_USD, UNNAMED, Asked, Ledger
from merge_runner.records import Attempt

PATIENCE_S = 90.0


class Budget:
    """Spending of one sweep in USD; without a cap everything passes, and is recorded.

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
        """Wait for a trial's allowance; raises TrialSuspended when no ending trial can free it."""
        if self.cap_usd is None:
            return
        if trial in self._left:
            raise TrialSuspended("its trial is suspended")
        self._at_the_door.append(trial)
        try:
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

    def forsake(self, trials: Iterable[int], *, in_flight: int, queued_usd: float) -> None:
        """Whoever played these trials is gone, and they may be admitted anew.

        Of the attempts ``in_flight`` those that were begun stay set aside in the ledger; what was
        set aside for the others, ``queued_usd`` in all, is free.
        """
        for trial in trials:
            self._allowances.pop(trial, None)
            self._left.discard(trial)
        self._in_flight -= in_flight
        self._queued_usd -= queued_usd
        self._tell()

    async def reserve(self, trial: int, worst_usd: float, driver: str = "") -> float:
        """Set an attempt's worst case aside; waits for others, else raises TrialSuspended.

        Returns what is set aside, which is more where the driver's server ignores the output cap.
        """
        waited_s = 0.0
        honest_usd = worst_usd
        while not self._taken(trial, worst_usd := honest_usd * self.ledger.spending.times(driver)):
            self._stuck.add(trial)
            try:
                if not self._in_flight and (
                    self._allowances.keys() <= self._stuck or waited_s >= PATIENCE_S
                ):
                    raise self._suspended(f"the next call may cost {worst_usd:.4f} USD")
                waited_s += await self._change()
            finally:
                self._stuck.discard(trial)
        self._in_flight += 1
        self._largest_usd = max(self._largest_usd, worst_usd)
        self._queued_usd += worst_usd
        return worst_usd

    async def begin(
        self, key: str, attempts: list[Attempt], worst_usd: float, asked: Asked = UNNAMED
    ) -> None:
        """The attempt is sent now: what is set aside for it becomes durable."""
        if not await self.ledger.reserve(key, attempts, worst_usd, self.cap_usd, asked):
            raise self._suspended("another run of the sweep spends from the same cap")
        self._queued_usd -= worst_usd

    def give_back(self, trial: int, worst_usd: float) -> None:
        """The attempt was not begun."""
        self._queued_usd -= worst_usd
        self.settled(trial, worst_usd)

    def settled(self, trial: int, freed_usd: float = 0.0) -> None:
        """An attempt has ended, and the ledger knows what it cost.

        ``freed_usd`` was set aside for one that cost nothing: the trial needs it again.
        """
        self._in_flight -= 1
        if trial in self._allowances:
            self._allowances[trial] = min(self._trial_usd, self._allowances[trial] + freed_usd)
        self._tell()

    @property
    def _committed_usd(self) -> float:
        return self.ledger.read().committed_usd + self._queued_usd

    def _taken(self, trial: int, worst_usd: float) -> bool:
        """Take an attempt's worst case, from the trial's allowance as far as that goes."""
        if self.cap_usd is None:
            return True
        own = min(worst_usd, self._allowances.get(trial, 0.0))
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
        """Wait for a change, a while; returns how long in s.

        Another process may hold a claim that a trial of ours waits for, and wait for ours.
        """
        loop = asyncio.get_running_loop()
        began = loop.time()
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(PATIENCE_S):
                await self._changed.wait()
        return loop.time() - began

    def _tell(self) -> None:
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
