"""What a sweep has spent, over all its runs: a durable number beside the replies it paid for.

Before each attempt at a paid call the worst case is set aside, in one transaction with a note of
the attempt and of the reason. A process that dies leaves them: its attempt counts with the worst
case until a user releases it, and stands in the call's list of attempts with an unknown outcome.
"""

from __future__ import annotations

import contextlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime

from pydantic import TypeAdapter, ValidationError

from merge_runner.errors import RecordingError, UsageError
from merge_runner.llm.cache import CachedCall, ResponseCache
from merge_runner.records import Attempt

TOLERANCE_USD = 1e-9  # sums of floats
IN_FLIGHT, UNRECORDED = "in flight", "not recorded"
EXAMPLES = 3  # slots that are named for a reason: enough to find the trials
_SPENT, _OPEN = "spent ", "open "


@dataclass(frozen=True, slots=True)
class Asked:
    """Who is asked, for which slot, and the most that costs if the output cap is respected.

    ``model`` is its name in the registry; ``driver`` names its endpoint, too.
    """

    driver: str = ""
    slot: str = ""
    honest_usd: float = 0.0
    model: str = ""


@dataclass(frozen=True, slots=True)
class SetAside:
    """One attempt of unknown cost; ``outcome`` stays IN_FLIGHT where its process died."""

    usd: float
    asked: Asked
    since: str
    outcome: str = IN_FLIGHT


@dataclass(slots=True)
class Reason:
    """Why something is set aside: ``attempts`` at one driver that came to the same outcome.

    ``first`` and ``last`` are UTC in ISO 8601; ``slots`` are some of those that it was for.
    """

    driver: str
    outcome: str
    attempts: int = 0
    usd: float = 0.0
    first: str = ""
    last: str = ""
    slots: list[str] = field(default_factory=list)

    def add(self, one: SetAside) -> None:
        """Count an attempt."""
        self.attempts += 1
        self.usd += one.usd
        self.first = min(self.first or one.since, one.since)
        self.last = max(self.last, one.since)
        if one.asked.slot not in self.slots and len(self.slots) < EXAMPLES:
            self.slots.append(one.asked.slot)


@dataclass(frozen=True, slots=True)
class Release:
    """What a user has released at their own risk, and why it had been set aside."""

    at: str
    usd: float
    attempts: int
    reasons: tuple[Reason, ...]


@dataclass(slots=True)
class Spending:
    """In USD: what attempts cost, and what is set aside for those whose cost is not known.

    ``open_attempts`` are in flight, or nobody knows what became of them. ``overrun_usd`` is by how
    much replies cost more than their worst case, ``overruns`` the largest such ratio by driver.
    """

    spent_usd: float = 0.0
    reserved_usd: float = 0.0
    open_attempts: int = 0
    overrun_usd: float = 0.0
    overruns: dict[str, float] = field(default_factory=dict)
    releases: list[Release] = field(default_factory=list)

    @property
    def committed_usd(self) -> float:
        """What may have been spent, at worst."""
        return self.spent_usd + self.reserved_usd

    def times(self, driver: str) -> float:
        """How often the worst case is set aside: more than once where a server ignores the cap."""
        return self.overruns.get(driver, 1.0)

    @property
    def dearest(self) -> str:
        """How much more than their worst case replies cost at most, by driver, in words."""
        ratios = self.overruns.items()
        return ", ".join(f"{driver} up to {ratio:.2f} times as much" for driver, ratio in ratios)


_SPENDING = TypeAdapter(Spending)
_SET_ASIDE = TypeAdapter(list[SetAside])


def scopes(cache: ResponseCache) -> list[str]:
    """The names of all ledgers in a cache."""
    return [name.removeprefix(_SPENT) for name in cache.names(_SPENT)]


class Ledger:
    """The spending of one sweep; ``scope`` names it in the cache. ``spending`` is its last state.

    Several processes may run the sweep: every change reads the state anew.
    """

    def __init__(self, cache: ResponseCache, scope: str) -> None:
        self.spending = Spending()
        self.scope = scope
        self._cache = cache
        self._name = _SPENT + scope
        self._open = f"{_OPEN}{scope} "
        # A damaged record is an error only where money is to be spent: a replay needs none.
        with contextlib.suppress(UsageError):
            self.read()

    async def reserve(
        self,
        key: str,
        attempts: Sequence[Attempt],
        worst_usd: float,
        cap_usd: float | None,
        asked: Asked,
    ) -> bool:
        """Set the worst case of a call's next attempt aside; False if that exceeds the cap."""
        return await self._cache.write(
            lambda: self.set_aside(key, attempts, worst_usd, cap_usd, asked)
        )

    def set_aside(
        self,
        key: str,
        attempts: Sequence[Attempt],
        worst_usd: float,
        cap_usd: float | None,
        asked: Asked,
    ) -> bool:
        """An operation on the cache: what ``reserve`` does."""
        # Read within the transaction: another process may have spent since.
        spending = self.read()
        committed_usd = spending.committed_usd + worst_usd
        if cap_usd is not None and committed_usd > cap_usd + TOLERANCE_USD:
            return False
        spending.reserved_usd += worst_usd
        spending.open_attempts += 1
        self._write(spending)
        self._write_open(key, [*self._opened(key), SetAside(worst_usd, asked, _now())])
        self._cache.keep_unanswered(key, (*attempts, _begun(len(attempts) + 1)))
        return True

    def aside_usd(self, key: str) -> float:
        """What is set aside for the last attempt at a call; 0 where nothing is."""
        opened = self._opened(key)
        return opened[-1].usd if opened else 0.0

    def other(self, scope: str) -> Ledger:
        """The ledger of this name in the same cache, which may be this one."""
        return self if scope == self.scope else Ledger(self._cache, scope)

    async def settle(
        self, key: str, attempts: Sequence[Attempt], worst_usd: float, asked: Asked
    ) -> None:
        """The last of a call's attempts brought no answer; its cost may be unknown."""

        def operation() -> None:
            self._settle(key, attempts, worst_usd, asked)
            self._cache.keep_unanswered(key, tuple(attempts))

        await self._cache.write(operation)

    async def keep(self, entry: CachedCall, worst_usd: float, asked: Asked) -> CachedCall:
        """Keep an answered call, and settle its last attempt in the same transaction."""
        key = entry.request.key
        return await self._cache.put(
            entry, lambda: self._settle(key, entry.attempts, worst_usd, asked)
        )

    def reserve_share(self, name: str, asked: Asked) -> None:
        """An operation: reserve a task's share of the cap, as if it were one attempt."""
        spending = self.read()
        spending.reserved_usd += asked.honest_usd
        spending.open_attempts += 1
        self._write(spending)
        self._write_open(name, [SetAside(asked.honest_usd, asked, _now())])

    def settle_share(
        self, name: str, task: Spending, opened: Mapping[str, Sequence[SetAside]]
    ) -> None:
        """An operation: put what a task has spent, and has open, in the place of its share."""
        spending = self.read()
        share = self._opened(name)  # none where a user has released it
        spending.spent_usd += task.spent_usd
        spending.reserved_usd += task.reserved_usd - sum(each.usd for each in share)
        spending.open_attempts += task.open_attempts - len(share)
        if not spending.open_attempts:
            spending.reserved_usd = 0.0  # what is left is rounding
        spending.overrun_usd += task.overrun_usd
        for driver, ratio in task.overruns.items():
            spending.overruns[driver] = max(ratio, spending.times(driver))
        self._write(spending)
        self._write_open(name, [])
        for key, attempts in opened.items():
            self._write_open(key, [*self._opened(key), *attempts])

    def opened(self) -> dict[str, list[SetAside]]:
        """The attempts without a known cost, by call key."""
        keys = (name.removeprefix(self._open) for name in self._cache.names(self._open))
        return {key: self._opened(key) for key in keys}

    def reasons(self) -> list[Reason]:
        """Why something is set aside, the largest sum first."""
        found: dict[tuple[str, str], Reason] = {}
        for attempts_of_call in self.opened().values():
            for one in attempts_of_call:
                driver = one.asked.driver
                found.setdefault((driver, one.outcome), Reason(driver, one.outcome)).add(one)
        spending = self.read()
        attempts = spending.open_attempts - sum(reason.attempts for reason in found.values())
        if attempts > 0:
            usd = spending.reserved_usd - sum(reason.usd for reason in found.values())
            found["", UNRECORDED] = Reason("", UNRECORDED, attempts, usd)
        return sorted(found.values(), key=lambda reason: -reason.usd)

    def release(self) -> Release:
        """Count no longer what is set aside; nobody may be asking meanwhile."""

        def operation() -> Release:
            spending = self.read()
            reasons = tuple(self.reasons())
            released = Release(_now(), spending.reserved_usd, spending.open_attempts, reasons)
            spending.open_attempts, spending.reserved_usd = 0, 0.0
            spending.releases.append(released)
            self._write(spending)
            for name in self._cache.names(self._open):
                self._cache.remove(name)  # its reasons are those of the release now
            return released

        released: Release = self._cache.run_now([operation])[0]
        return released

    def _settle(
        self, key: str, attempts: Sequence[Attempt], worst_usd: float, asked: Asked
    ) -> None:
        actual_usd = attempts[-1].cost_usd
        opened = self._opened(key)
        # A batch may end after its money was released.
        released = not opened and worst_usd == 0
        # The row of reasons may be damaged; the sums, which the cap needs, lie elsewhere.
        *earlier, one = opened or [SetAside(worst_usd, asked, _now())]
        if actual_usd is None:
            self._write_open(key, [*earlier, replace(one, outcome=attempts[-1].outcome)])
            return  # it stays set aside: it may have been charged
        self._write_open(key, earlier)
        spending = self.read()
        spending.spent_usd += actual_usd
        spending.reserved_usd = max(0.0, spending.reserved_usd - worst_usd)
        if not released:
            spending.open_attempts -= 1
        if not spending.open_attempts:
            spending.reserved_usd = 0.0  # what is left is rounding
        if not released and actual_usd > worst_usd + TOLERANCE_USD:
            spending.overrun_usd += actual_usd - worst_usd
            driver, honest_usd = one.asked.driver, one.asked.honest_usd or worst_usd
            ratio = actual_usd / max(honest_usd, TOLERANCE_USD)
            spending.overruns[driver] = max(ratio, spending.times(driver))
        self._write(spending)

    def _opened(self, key: str) -> list[SetAside]:
        """The attempts at a call that have no known cost, the one in flight last."""
        try:
            text = self._cache.read(self._open + key)
            return [] if text is None else _SET_ASIDE.validate_json(text)
        except (RecordingError, ValidationError):
            return []  # damaged: the sums, which count, lie elsewhere

    def _write_open(self, key: str, attempts: list[SetAside]) -> None:
        if attempts:
            text = _SET_ASIDE.dump_json(attempts).decode()
            self._cache.replace(self._open + key, text)
        else:
            self._cache.remove(self._open + key)

    def read(self) -> Spending:
        """The current state; raises UsageError where its record is damaged."""
        try:
            text = self._cache.read_checked(self._name)
            self.spending = Spending() if text is None else _SPENDING.validate_json(text)
            if not (self.spending.spent_usd >= 0 and self.spending.reserved_usd >= 0):
                raise RecordingError("no sweep can have spent that")
        except (RecordingError, ValidationError) as exc:
            raise UsageError(
                f"the record of what this sweep has spent ({self._name!r} in the cache "
                f"{self._cache.folder}) is damaged, so that no cap could hold: take the replies "
                f"with `merge-runner recording import {self._cache.folder} --cache NEW`, and go "
                "on with --cache NEW, which counts from 0"
            ) from exc
        return self.spending

    def _write(self, spending: Spending) -> None:
        self.spending = spending
        self._cache.replace_checked(self._name, _SPENDING.dump_json(spending).decode())


def _begun(number: int) -> Attempt:
    """An attempt as it is noted before it is made; what comes of it takes its place."""
    return Attempt(
        number=number,
        outcome="unknown",
        started_at=_now(),
        error="the run ended before a reply was seen; it may have been charged",
    )


def _now() -> str:
    return datetime.now(UTC).isoformat(timespec="milliseconds")
