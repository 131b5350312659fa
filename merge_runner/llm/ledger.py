"""The money of sweeps: what attempts cost, and what is reserved, summed over all their runs.

The worst case of an attempt is reserved durably right before it is sent, in one transaction that
sums what is spent and open (``Budget``). What it cost is settled in the transaction that keeps its
reply. A process that dies leaves its reservations: these attempts count with their worst case until
a user releases them, and are listed with an unknown outcome.

A server may ignore the output cap. What a reply cost beyond its worst case is taken from what is
left, and from then on the worst case is multiplied by as much as that driver's most expensive reply
exceeded it.
"""

from __future__ import annotations

import contextlib
import json
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from typing import Any

from merge_runner.errors import CacheFailed, RecordingError, UsageError
from merge_runner.llm.cache import ResponseCache
from merge_runner.llm.cache_file import FILE
from merge_runner.llm.durable import Execute, Rows
from merge_runner.records import Attempt

TOLERANCE_USD = 1e-9  # sums of floats
_SPENT = "SELECT driver, usd, overrun_usd, most_overrun FROM spent WHERE scope = ?1"
# In one statement: what is settled meanwhile is in the one or in the other sum. First what is open,
# then what others hold under the same cap.
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


@dataclass(frozen=True, slots=True)
class Asked:
    """Which driver at which endpoint is asked, for which slot, and the most that honestly costs."""

    driver: str = ""
    slot: str = ""
    honest_usd: float = 0.0


APART = (
    "A ledger and a run's replies may cost different sums: the ledger has all that was paid for a "
    "sweep, over all its runs and also for replies that no stored trial uses, and sets aside "
    "attempts of unknown cost; the replies of a run may have been paid by another sweep."
)
"""Why two sums differ that are shown side by side."""


@dataclass(frozen=True, slots=True)
class Spending:
    """In USD: what attempts cost, and what is reserved for those whose cost is not known.

    ``open_attempts`` are in flight, or nobody knows what became of them. ``overrun_usd`` is by how
    much replies cost more than their worst case, ``overruns`` the largest such ratio by driver.
    """

    spent_usd: float = 0.0
    reserved_usd: float = 0.0
    open_attempts: int = 0
    overrun_usd: float = 0.0
    overruns: dict[str, float] = field(default_factory=dict)

    @property
    def committed_usd(self) -> float:
        """The most that may have been spent."""
        return self.spent_usd + self.reserved_usd

    @property
    def dearest(self) -> str:
        """The largest overruns by driver, in words."""
        ratios = self.overruns.items()
        return ", ".join(f"{driver} up to {ratio:.2f} times as much" for driver, ratio in ratios)


def scopes(store: ResponseCache) -> list[str]:
    """Return the names of all ledgers in a cache."""
    rows = store.rows("SELECT scope FROM spent UNION SELECT scope FROM open ORDER BY 1")
    return [scope for (scope,) in rows]


class Ledger:
    """The spending of one sweep; ``scope`` names it in the cache. ``spending`` is as last summed.

    Several processes may run the sweep: every transaction sums anew. The ledger of a model that
    costs nothing has no name, and keeps no record. What ``others`` hold counts under the same cap:
    ``committed_usd`` is the most that may have been spent under it by now.
    """

    is_shared_out = False  # by a coordinator, which is asked before each attempt

    def __init__(self, store: ResponseCache, scope: str, others: Sequence[str] = ()) -> None:
        self.store = store
        self.scope = scope
        self.spending = Spending()
        self.committed_usd = 0.0
        self._others = json.dumps(others)
        # A damaged record is an error only where money is to be spent: a replay needs none.
        with contextlib.suppress(UsageError, CacheFailed, RecordingError):
            self.read()

    def read(self) -> Spending:
        """Return the current state; raises UsageError where its record is damaged."""
        if self.scope:
            self._sum(self.store.rows(_SUMS, self.scope, self._others))
        return self.spending

    def _sum(self, rows: Iterable[tuple[Any, ...]]) -> None:
        """Take the rows of _SUMS; raises UsageError for sums that cannot be."""
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
        self.committed_usd = spent_usd + reserved_usd + elsewhere_usd

    def _sum_once(self, execute: Execute) -> None:
        """Sum before the first change that this ledger makes in a transaction."""
        if self.store.summed is not self:
            self._sum(execute(_SUMS, (self.scope, self._others)))
            self.store.summed = self

    def reserve(
        self,
        key: str,
        number: int,
        usd: float,
        cap_usd: float | None,
        asked: Asked,
        execute: Execute,
    ) -> bool:
        """Reserve the worst case of an attempt; False if that exceeds the cap; an operation."""
        self._sum_once(execute)
        if cap_usd is not None and self.committed_usd + usd > cap_usd + TOLERANCE_USD:
            return False
        since = datetime.now(UTC).isoformat(timespec="milliseconds")
        place = (asked.driver, asked.slot, asked.honest_usd, since, "in flight")
        execute(_OPEN, (self.scope, key, number, usd, *place))
        self.committed_usd += usd
        return True

    async def ask(self, key: str, usd: float, asked: Asked) -> bool:
        """Return whether the coordinator has money for an attempt, where there is one."""
        return True

    def ended(self, key: str, usd: float | None) -> None:
        """Say there what an attempt at a call has cost; None: unknown."""

    def settle(self, key: str, attempt: Attempt, driver: str, execute: Execute) -> None:
        """Settle what an attempt at a call cost; an operation.

        Its reservation stays where the cost is unknown.
        """
        if not self.scope:
            return
        if attempt.cost_usd is None:  # it may have been charged
            execute(_KEEP, (attempt.outcome, key, attempt.number))
        else:
            self.pay(key, attempt.number, attempt.cost_usd, driver, execute)

    def pay(
        self, key: str, number: int, usd: float, driver: str, execute: Execute
    ) -> tuple[str, float, float]:
        """Count what an attempt has cost as spent, no longer its worst case; an operation.

        Returns the driver, the cost, and by how much that exceeds the worst case.
        """
        self._sum_once(execute)
        closed = execute(_CLOSE, (key, number)).fetchall()
        # None: a user has released it. That of a line is of the sweep that has submitted its batch.
        scope, aside_usd, honest_usd = closed[0] if closed else (self.scope, usd, usd)
        exceeds = usd > aside_usd + TOLERANCE_USD
        over = (usd - aside_usd, usd / max(honest_usd, TOLERANCE_USD)) if exceeds else (0.0, 0.0)
        execute(_PAY, (scope, driver, usd, *over))
        if exceeds or not closed or scope != self.scope:
            self._sum(execute(_SUMS, (self.scope, self._others)))
        else:
            self.committed_usd += usd - aside_usd
        return driver, usd, over[0]

    def reserved_usd(self, key: str) -> float:
        """Return the USD reserved for the last attempt at a call; 0: a user has released them."""
        rows = self.store.rows("SELECT usd FROM open WHERE call = ? ORDER BY attempt", key)
        return float(rows[-1][0]) if rows else 0.0

    def rows(self) -> tuple[Rows, Rows]:
        """Return the rows of what is spent and of what is open, for ``share``."""
        opened = self.store.rows("SELECT * FROM open WHERE scope = ?", self.scope)
        return self.store.rows(_SPENT, self.scope), [row[1:] for row in opened]

    def share(self, name: str, spent: Rows, opened: Rows, execute: Execute) -> None:
        """Count what a task has spent and has open, no longer what is reserved by its name.

        An operation.
        """
        execute("DELETE FROM open WHERE scope = ? AND call = ?", (self.scope, name))
        for row in spent:
            execute(_PAY, (self.scope, *row))
        for row in opened:
            execute(_OPEN, (self.scope, *row))

    def reasons(self) -> list[dict[str, Any]]:
        """Return the reservations by driver and outcome, with times in UTC and one of the slots."""
        names = ("driver", "outcome", "attempts", "usd", "first", "last", "slot")
        return [dict(zip(names, r, strict=True)) for r in self.store.rows(_REASONS, self.scope)]

    def release(self) -> None:
        """Count no longer what is reserved; nobody may be asking meanwhile."""

        def release(execute: Execute) -> None:
            execute("DELETE FROM open WHERE scope = ?", (self.scope,))

        self.store.run_now([release])
        self.read()
