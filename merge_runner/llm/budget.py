"""Caps on what sweeps spend, over all their runs, that hold whatever happens.

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
from collections import defaultdict
from collections.abc import AsyncIterator, Callable, Collection, Iterable, Mapping, Sequence
from contextlib import asynccontextmanager
from dataclasses import dataclass, field

from merge_runner.errors import TrialSuspended
from merge_runner.llm.cache import CachedCall
from merge_runner.llm.ledger import NO_CAPS, TOLERANCE_USD, Asked, Caps, Ledger, Spending
from merge_runner.llm.shared_services import CachePort
from merge_runner.llm.trial_costs import TrialCosts
from merge_runner.records import Attempt

# An older trial that has money kept for it may wait for a call of a younger one, which waits for
# money: after this long, with nothing in flight, it is no longer counted on.
PATIENCE_S = 90.0
NOTHING_EXPECTED = TrialCosts(str, {}, {})


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
    # What its trial was charged, by model; a trial that begins anew has another account.
    account: defaultdict[str, float] = field(default_factory=lambda: defaultdict(float))
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
        """An operation on the cache: the durable part of ``begin``; False if a cap is used up."""
        return self.ledger.set_aside(
            self.key, attempts, self.aside_usd, self.budget.caps, self.asked
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


@dataclass(slots=True)
class Pot:
    """The money under one cap, in USD: that of one model, or of all (None).

    ``queued_usd`` is set aside in this process alone; ``in_flight`` counts the attempts with money
    of this pot, and ``largest_usd`` is the most that was set aside for one.
    """

    model: str | None
    cap_usd: float
    in_flight: int = 0
    queued_usd: float = 0.0
    largest_usd: float = 0.0

    def pays(self, models: Collection[str]) -> bool:
        """Whether it pays for any of these models."""
        return self.model is None or self.model in models

    def part(self, by_model: Mapping[str, float]) -> float:
        """The part of such a sum that it pays."""
        return sum(by_model.values()) if self.model is None else by_model.get(self.model, 0.0)

    def left_usd(self, spending: Spending) -> float:
        """What is neither spent nor set aside."""
        return self.cap_usd - spending.committed_for(self.model) - self.queued_usd

    def twice_usd(self, aside_usd: float) -> float:
        """What must be left beside an attempt so that all in flight may cost twice as much."""
        # A server that ignores the output cap is known only by its first dear reply, when the
        # others are sent already.
        return (self.in_flight + 1) * max(aside_usd, self.largest_usd) if self.in_flight else 0.0


@dataclass(slots=True, eq=False)
class _Place:
    """A place in a line, that of the oldest trial first."""

    trial: int
    number: int
    told: asyncio.Event = field(default_factory=asyncio.Event)


class Budget:
    """Spending under the caps in USD; without a cap nothing is refused, and all of it recorded.

    A trial is named by its order in the sweep.
    """

    def __init__(
        self, ledger: Ledger, caps: Caps = NO_CAPS, costs: TrialCosts = NOTHING_EXPECTED
    ) -> None:
        self.ledger = ledger
        self.caps = caps
        self.costs = costs
        self._pots = [Pot(model, cap_usd) for model, cap_usd in caps]
        # What each trial that has begun was charged, and has set aside, by model.
        self._begun: dict[int, defaultdict[str, float]] = {}
        self._left: set[int] = set()
        # Trials at the door by the models that they ask, attempts by their model: where one cap is
        # used up, what other caps pay for goes on.
        self._door: defaultdict[frozenset[str], list[_Place]] = defaultdict(list)
        self._attempts: defaultdict[str, list[_Place]] = defaultdict(list)
        self._numbers = itertools.count()

    async def admit(self, trial: int) -> None:
        """Wait until a trial may begin; raises TrialSuspended when no trial's end can let it."""
        if not self._pots or trial in self._begun:
            return
        if trial in self._left:
            raise TrialSuspended("its trial is suspended")
        line = self._door[frozenset(self.costs.of(trial))]
        await self._in_line(line, trial, lambda first, _: self._begins(trial, first))

    def begin_anew(self, trial: int) -> None:
        """The trial goes on where an earlier run has asked for it, so that it waits for nothing."""
        if self._pots and trial not in self._left:
            self._begun.setdefault(trial, defaultdict(float))

    def leave(self, trial: int) -> None:
        """The trial has ended or is suspended, and needs no more money."""
        self._left.add(trial)
        if self._begun.pop(trial, None) is not None:
            self._tell()

    def readmit(self, trials: Iterable[int]) -> None:
        """The worker that played these trials is gone, and they may be admitted anew."""
        for trial in trials:
            self._begun.pop(trial, None)
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

        Waits while other attempts or older trials may free money, then raises TrialSuspended. The
        caller closes what is returned; ``attempt`` does so by itself.
        """
        paid = PaidAttempt(self, self.ledger, trial, key, asked)
        if not self._pots:
            paid.aside_usd = self._expected_usd(asked)
        else:
            line = self._attempts[asked.model]
            await self._in_line(
                line, trial, lambda first, waited_s: first and self._taken(paid, waited_s)
            )
        return paid

    @asynccontextmanager
    async def going_on(
        self, trial: int, key: str, asked: Asked, scope: str
    ) -> AsyncIterator[PaidAttempt]:
        """The money of an attempt that an earlier run has begun, under the ledger of this name."""
        ledger = self.ledger.other(scope)
        paid = PaidAttempt(self, ledger, trial, key, asked, ledger.aside_usd(key), queued=False)
        for pot in self._pots_of(asked):
            pot.in_flight += 1
        paid.account = self._begun.get(trial, paid.account)
        paid.account[asked.model] += paid.aside_usd
        try:
            yield paid
        finally:
            paid.close()

    async def make_durable(self, paid: PaidAttempt, attempts: Sequence[Attempt]) -> None:
        """Move what is set aside for an attempt to the ledger; raises TrialSuspended."""
        if not await self.ledger.reserve(paid.key, attempts, paid.aside_usd, self.caps, paid.asked):
            raise TrialSuspended("another run spends from the same cap, and has used it up")
        self.unqueue(paid)

    def end(self, paid: PaidAttempt) -> None:
        """An attempt has ended."""
        for pot in self._pots_of(paid.asked):
            pot.in_flight -= 1
        paid.account[paid.asked.model] += paid.charged_usd - paid.aside_usd
        if paid.queued:
            self.unqueue(paid)
        self._tell()

    def unqueue(self, paid: PaidAttempt) -> None:
        """What is set aside for an attempt lies in the ledger now, or is given back."""
        paid.queued = False
        for pot in self._pots_of(paid.asked):
            pot.queued_usd -= paid.aside_usd

    def _begins(self, trial: int, first: bool) -> bool:
        """Whether a trial may begin: there is money for it beside all that have begun."""
        if trial in self._begun:  # its other driver stood in the line, too
            return True
        if not first:
            return False
        needed, spending = self.costs.of(trial), self.ledger.read()
        for pot in self._pots:
            if not pot.pays(needed):
                continue
            begun = [other for other in self._begun if pot.pays(self.costs.of(other))]
            beside_usd = self._needed_usd(pot, begun) + self._before_usd(pot, trial)
            left_usd = pot.left_usd(spending) - pot.part(needed) + TOLERANCE_USD
            if left_usd < 0 and not begun and not pot.in_flight:
                if not any(map(spending.committed_for, needed)):
                    continue  # the first one shows what a trial costs; each attempt must still fit
                raise self._suspended(
                    f"a whole trial may cost {pot.part(needed):.2f} USD", pot, spending
                )
            if left_usd < beside_usd:
                return False
        self._begun[trial] = defaultdict(float)
        return True

    def _taken(self, paid: PaidAttempt, waited_s: float) -> bool:
        """Whether there is money for an attempt, which is taken."""
        aside_usd, spending = self._expected_usd(paid.asked), self.ledger.read()
        pots = self._pots_of(paid.asked)
        for pot in pots:
            left_usd = pot.left_usd(spending) - aside_usd + TOLERANCE_USD
            if left_usd < 0 and not pot.in_flight:
                raise self._suspended(f"the next call may cost {aside_usd:.4f} USD", pot, spending)
            counted_on = pot.in_flight or waited_s < PATIENCE_S
            older = (trial for trial in self._begun if trial < paid.trial and counted_on)
            older_usd = self._needed_usd(pot, older)
            if left_usd < max(older_usd, pot.twice_usd(aside_usd)):
                return False
        for pot in pots:
            pot.in_flight += 1
            pot.queued_usd += aside_usd
            pot.largest_usd = max(pot.largest_usd, aside_usd)
        paid.aside_usd = aside_usd
        paid.account = self._begun.get(paid.trial, paid.account)
        paid.account[paid.asked.model] += aside_usd
        return True

    def _expected_usd(self, asked: Asked) -> float:
        """The worst case, as many times as this driver's dearest reply has cost it."""
        return asked.honest_usd * self.ledger.spending.times(asked.driver)

    def _pots_of(self, asked: Asked) -> list[Pot]:
        return [pot for pot in self._pots if pot.pays((asked.model,))]

    def _needed_usd(self, pot: Pot, trials: Iterable[int]) -> float:
        """What these begun trials are still expected to cost a pot."""
        return sum(max(0.0, self._rest_usd(pot, trial)) for trial in trials)

    def _rest_usd(self, pot: Pot, trial: int) -> float:
        return pot.part(self.costs.of(trial)) - pot.part(self._begun[trial])

    def _before_usd(self, pot: Pot, trial: int) -> float:
        """What older trials will take that are the first of other lines at the door."""
        first = (places[0].trial for places in self._door.values() if places)
        return sum(
            pot.part(self.costs.of(older))
            for older in first
            if older < trial and older not in self._begun
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
        for line in (*self._door.values(), *self._attempts.values()):
            for place in line[:1]:
                place.told.set()
        for place in itertools.chain.from_iterable(self._door.values()):
            if place.trial in self._begun:
                place.told.set()

    def _suspended(self, what: str, pot: Pot, spending: Spending) -> TrialSuspended:
        sums = spending.part(pot.model) if pot.model else spending
        aside_usd = sums.reserved_usd + pot.queued_usd
        committed_usd = pot.cap_usd - pot.left_usd(spending)
        kept_usd = self._needed_usd(pot, self._begun)
        return TrialSuspended(
            f"{what}, and {committed_usd:.4f} of {pot.cap_usd:g} USD"
            + (f" for {pot.model}" if pot.model else "")
            + f" are spent or set aside ({sums.spent_usd:.4f} spent"
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

    cache: CachePort

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

    cache: CachePort
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
