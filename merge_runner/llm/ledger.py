"""Spending of a sweep: cost of attempts and reservations, summed over all its runs.

The worst case of an attempt is reserved durably right before it is sent, in one transaction that
sums what is spent and reserved. Its cost is booked in the transaction that keeps its reply. A
process that dies leaves its reservations: these attempts count with their worst case until a user
releases them, and are listed with an unknown outcome.

A server may ignore the output cap. The cost of a reply beyond its worst case is booked, and from
then on the worst case is scaled by that driver's largest overrun.
"""

from __future__ import annotations

import contextlib
import json
import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from datetime import UTC, datetime
from typing import Any, NamedTuple

from merge_runner.errors import CacheFailed, RecordingError, UsageError
from merge_runner.llm.cache_format import FILE
from merge_runner.llm.durable import Execute
from merge_runner.llm.store import CacheFile
from merge_runner.records import Attempt

TOLERANCE_USD = 1e-9  # sums of floats
_SPENT = "SELECT driver, usd, overrun_usd, most_overrun FROM spent WHERE scope = ?1"
# One statement, so that what is booked meanwhile is in one of the sums: first the reservations,
# then the other ledgers under the same cap.
_SUMS = f"""
SELECT NULL, total(usd), count(*), 0 FROM open WHERE scope = ?1
UNION ALL SELECT NULL, total(usd), 0, 0
FROM (SELECT scope, usd FROM open UNION ALL SELECT scope, usd FROM spent)
WHERE scope IN (SELECT value FROM json_each(?2))
UNION ALL {_SPENT}
"""  # noqa: S608
_OPEN = "INSERT INTO open VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?)"
_PAY = """
INSERT INTO spent VALUES (?, ?, ?, ?, ?) ON CONFLICT DO UPDATE SET usd = usd + excluded.usd,
overrun_usd = overrun_usd + excluded.overrun_usd,
most_overrun = max(most_overrun, excluded.most_overrun)
"""
_KEEP = """
UPDATE open SET outcome = ? WHERE rowid =
(SELECT max(rowid) FROM open WHERE call = ? AND attempt = ?)
"""
_CLOSE = """
DELETE FROM open WHERE rowid =
(SELECT max(rowid) FROM open WHERE call = ? AND attempt = ?)
RETURNING scope, usd, worst_usd
"""
_REASONS = """
SELECT driver, outcome, count(*), sum(usd), min(since), max(since), min(slot) FROM open
WHERE scope = ? GROUP BY driver, outcome ORDER BY sum(usd) DESC
"""


class Cap(NamedTuple):
    """Spending limit of a ledger, ``usd``, as ``source`` sets it; ``others`` share it."""

    usd: float
    source: str = "--max-cost"
    others: tuple[str, ...] = ()


class CallLabel(NamedTuple):
    """Driver and slot of a call, and the worst case if its server keeps to the output cap."""

    driver: str = ""
    slot: str = ""
    worst_usd: float = 0.0


APART = (
    "A ledger has all that was paid for a sweep, also for replies that no stored trial uses, and "
    "attempts of unknown cost at their worst case; a run has the cost of its trials' replies, "
    "whoever paid."
)
"""Explains why two sums differ that are shown side by side."""


@dataclass(frozen=True, slots=True)
class Spending:
    """Spent and reserved USD of a ledger.

    ``open_attempts`` are in flight, or their cost is unknown. ``overrun_usd`` sums the cost of
    replies beyond their worst case, ``overruns`` has the largest such ratio by driver.
    """

    spent_usd: float = 0.0
    reserved_usd: float = 0.0
    open_attempts: int = 0
    overrun_usd: float = 0.0
    overruns: dict[str, float] = field(default_factory=dict)

    @property
    def committed_usd(self) -> float:
        """Spent and reserved USD: the most that may have been spent."""
        return self.spent_usd + self.reserved_usd

    @property
    def largest_overruns(self) -> str:
        """The largest overrun of each driver, as text."""
        ratios = self.overruns.items()
        return ", ".join(f"{driver} up to {ratio:.2f} times as much" for driver, ratio in ratios)


def scopes(store: CacheFile) -> list[str]:
    """Return the names of all ledgers in a cache."""
    rows = store.rows("SELECT scope FROM spent UNION SELECT scope FROM open ORDER BY 1")
    return [scope for (scope,) in rows]


def reasons(store: CacheFile, scope: str) -> list[dict[str, Any]]:
    """Return a ledger's reservations by driver and outcome, with UTC times and one of the slots."""
    names = ("driver", "outcome", "attempts", "usd", "first", "last", "slot")
    return [dict(zip(names, row, strict=True)) for row in store.rows(_REASONS, scope)]


def reserved_usd_of(store: CacheFile, key: str) -> float:
    """Return the USD reserved for a call's last attempt; 0 if a user has released them."""
    rows = store.rows("SELECT usd FROM open WHERE call = ? ORDER BY attempt", key)
    return float(rows[-1][0]) if rows else 0.0


class Ledger:
    """Spending of one sweep, named ``scope`` in the cache, under a ``cap``; None: no limit.

    ``spending`` is the last sum; ``committed_usd`` includes the other ledgers under the cap.
    Several processes may run the sweep, so every transaction sums first. The ledger of a free model
    has no name and keeps no record.
    """

    def __init__(self, store: CacheFile, scope: str, cap: Cap | None = None) -> None:
        self.store = store
        self.scope = scope
        self.cap = cap
        self.spending = Spending()
        self.committed_usd = 0.0
        self._in_transaction_usd = 0.0  # the writer's: read() may replace committed_usd meanwhile
        self._others = json.dumps(cap.others if cap else ())
        # A replay spends nothing and needs no record: a damaged one is an error only in a live run.
        with contextlib.suppress(UsageError, CacheFailed, RecordingError):
            self.read()

    @property
    def left_usd(self) -> float:
        """USD under the cap that are neither spent nor reserved; infinite without a cap."""
        return self.cap.usd - self.committed_usd if self.cap is not None else math.inf

    def read(self) -> Spending:
        """Sum the record anew, into ``spending`` and ``committed_usd``, and return the spending.

        Raises UsageError where it is damaged.
        """
        if self.scope:
            self.committed_usd = self._sum(self.store.rows(_SUMS, self.scope, self._others))
        return self.spending

    def _sum(self, rows: Iterable[tuple[Any, ...]]) -> float:
        """Take the rows of _SUMS, and return their sum; raise UsageError for impossible ones."""
        (_, reserved_usd, attempts, _), (_, elsewhere_usd, _, _), *spent = rows
        spent_usd = overrun_usd = 0.0
        overruns = {}
        for driver, usd, over_usd, most in spent:
            spent_usd += usd
            overrun_usd += over_usd
            if most > 0:
                overruns[driver] = most
        if not (spent_usd >= 0 and reserved_usd >= 0):
            folder = self.store.folder
            raise UsageError(
                f"the record of what sweeps have spent ({folder / FILE}) cannot be used, so that "
                "no cap could hold (no sweep can have spent that): put a copy of it back, or take "
                f"the replies with `merge-runner recording import {folder} --cache NEW`, and go "
                "on with --cache NEW, which counts from 0"
            )
        self.spending = Spending(spent_usd, reserved_usd, attempts, overrun_usd, overruns)
        committed_usd: float = spent_usd + reserved_usd + elsewhere_usd
        return committed_usd

    def refresh(self, execute: Execute) -> None:
        """Sum, once before the first change of this ledger in a transaction.

        This counts all earlier writes, some of which read() might miss.
        """
        if self.store.summed is not self:
            self._in_transaction_usd = self._sum(execute(_SUMS, (self.scope, self._others)))
            self.store.summed = self
        self.committed_usd = self._in_transaction_usd

    def reserve(
        self, key: str, number: int, usd: float, label: CallLabel, execute: Execute
    ) -> bool:
        """Reserve an attempt's worst case; False if it exceeds the cap. Runs in a transaction."""
        self.refresh(execute)
        if self.cap is not None and (self._in_transaction_usd + usd > self.cap.usd + TOLERANCE_USD):
            return False
        since = datetime.now(UTC).isoformat(timespec="milliseconds")
        place = (label.driver, label.slot, label.worst_usd, since, "in flight")
        execute(_OPEN, (self.scope, key, number, usd, *place))
        self._in_transaction_usd += usd
        self.committed_usd = self._in_transaction_usd
        return True

    def book(self, key: str, attempt: Attempt, driver: str, execute: Execute) -> None:
        """Replace the reservation of an attempt by its cost. Runs in a transaction.

        The reservation stays where the cost is unknown.
        """
        if not self.scope:
            return
        usd = attempt.cost_usd
        if usd is None:  # it may have been charged
            execute(_KEEP, (attempt.outcome, key, attempt.number))
            return
        self.refresh(execute)
        closed = execute(_CLOSE, (key, attempt.number)).fetchall()
        # No row: a user has released it. The reservation of a batch is of the sweep that sent it.
        scope, reserved_usd, worst_usd = closed[0] if closed else (self.scope, usd, usd)
        exceeds = usd > reserved_usd + TOLERANCE_USD
        over = (usd - reserved_usd, usd / max(worst_usd, TOLERANCE_USD)) if exceeds else (0.0, 0.0)
        execute(_PAY, (scope, driver, usd, *over))
        if exceeds or not closed or scope != self.scope:
            self._in_transaction_usd = self._sum(execute(_SUMS, (self.scope, self._others)))
        else:
            self._in_transaction_usd += usd - reserved_usd
        self.committed_usd = self._in_transaction_usd

    def add_overruns(self, overruns: Mapping[str, float], execute: Execute) -> None:
        """Add the largest overruns that another ledger has, by driver. Runs in a transaction."""
        for driver, ratio in overruns.items():
            execute(_PAY, (self.scope, driver, 0.0, 0.0, ratio))

    def release(self) -> None:
        """Drop all reservations; no run may be live."""

        def release(execute: Execute) -> None:
            execute("DELETE FROM open WHERE scope = ?", (self.scope,))

        self.store.run_now([release])
        self.read()
