"""What a sweep has spent, over all its runs: a durable number beside the replies it paid for.

Before each attempt at a paid call the worst case is set aside, in one transaction with a note of
the attempt. A process that dies leaves both: its attempt counts with the worst case for ever, and
is found in the call's list of attempts as one of unknown fate.
"""

from __future__ import annotations

import contextlib
from dataclasses import dataclass
from datetime import UTC, datetime

from pydantic import TypeAdapter, ValidationError

from merge_runner.errors import RecordingError, UsageError
from merge_runner.llm.cache import Entry, ResponseCache
from merge_runner.records import Attempt

TOLERANCE_USD = 1e-9  # sums of floats
_SPENT = "spent "


@dataclass(slots=True)
class Spending:
    """In USD: what attempts cost, and what is set aside for those whose cost is not known.

    ``open_attempts`` are in flight, or nobody knows what became of them.
    """

    spent_usd: float = 0.0
    reserved_usd: float = 0.0
    open_attempts: int = 0

    @property
    def committed_usd(self) -> float:
        """What may have been spent, at worst."""
        return self.spent_usd + self.reserved_usd


_SPENDING = TypeAdapter(Spending)


class Ledger:
    """The spending of one sweep; ``scope`` names it in the cache. ``spending`` is its last state.

    Several processes may run the sweep: every change reads the state anew.
    """

    def __init__(self, cache: ResponseCache, scope: str) -> None:
        self.spending = Spending()
        self._cache = cache
        self._name = _SPENT + scope
        with contextlib.suppress(UsageError):  # told where money is spent
            self.read()

    async def reserve(
        self, key: str, attempts: list[Attempt], worst_usd: float, cap_usd: float | None
    ) -> bool:
        """Set the worst case of a call's next attempt aside; False if that exceeds the cap."""

        def operation() -> bool:
            spending = self.read()
            allowed = None if cap_usd is None else cap_usd + TOLERANCE_USD
            if allowed is not None and spending.committed_usd + worst_usd > allowed:
                return False
            spending.reserved_usd += worst_usd
            spending.open_attempts += 1
            self._write(spending)
            self._cache.keep_unanswered(key, (*attempts, _begun(len(attempts) + 1)))
            return True

        reserved: bool = await self._cache.write(operation)
        return reserved

    async def settle(
        self, key: str, attempts: list[Attempt], worst_usd: float, actual_usd: float | None
    ) -> None:
        """An attempt brought no answer, or was not made after all; None: its cost is unknown.

        ``attempts`` are all that were made up to now.
        """

        def operation() -> None:
            self._settle(worst_usd, actual_usd)
            self._cache.keep_unanswered(key, tuple(attempts))

        await self._cache.write(operation)

    async def keep(self, entry: Entry, worst_usd: float, actual_usd: float | None) -> Entry:
        """Keep an answered call, and settle its last attempt with it."""
        return await self._cache.put(entry, lambda: self._settle(worst_usd, actual_usd))

    def _settle(self, worst_usd: float, actual_usd: float | None) -> None:
        if actual_usd is None:
            return
        spending = self.read()
        spending.spent_usd += actual_usd
        spending.reserved_usd = max(0.0, spending.reserved_usd - worst_usd)
        spending.open_attempts -= 1
        if not spending.open_attempts:
            spending.reserved_usd = 0.0  # what is left is rounding
        self._write(spending)

    def read(self) -> Spending:
        """The state of now."""
        try:
            text = self._cache.read_twice(self._name)
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
        self._cache.replace_twice(self._name, _SPENDING.dump_json(spending).decode())


def _begun(number: int) -> Attempt:
    """An attempt as it is noted before it is made; what comes of it takes its place."""
    return Attempt(
        number=number,
        outcome="unknown",
        started_at=datetime.now(UTC).isoformat(timespec="milliseconds"),
        error="the run ended before a reply was seen; it may have been charged",
    )
