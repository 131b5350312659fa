"""The money of sweeps: what attempts cost, and a reservation for each whose cost is not known.

What tokens cost is told by the registry's figures, or by the table of genai-prices.

Before each attempt at a paid call its worst case is reserved, in one transaction that sums what is
spent and open. A process that dies leaves its reservations: each attempt counts with its worst case
until a user releases it, and stands in the call's list of attempts with an unknown outcome.
"""

from __future__ import annotations

import contextlib
import sqlite3
from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass, field
from datetime import UTC, datetime
from decimal import Decimal
from functools import partial
from pathlib import Path
from threading import RLock
from typing import TYPE_CHECKING, Any

from merge_runner.config import ModelEntry, Price
from merge_runner.errors import CacheFailed, RecordingError, UsageError
from merge_runner.llm.durable import BatchWriter, Connection, Operation, connect, making
from merge_runner.records import Attempt, Usage

if TYPE_CHECKING:
    from merge_runner.llm.cache import ResponseCache

FILE = "ledger.db"
TOLERANCE_USD = 1e-9  # sums of floats
# The provider names of genai-prices where they differ from ours.
GENAI_PRICES_PROVIDER = {"gemini": "google"}
PER_MILLION = Decimal(1_000_000)
Rows = list[tuple[Any, ...]]
# Sums of what is spent, since a sum over all attempts at each reservation would take ever longer.
TABLES = """
BEGIN IMMEDIATE;
CREATE TABLE IF NOT EXISTS spent (
  scope TEXT, driver TEXT, usd REAL NOT NULL, overrun_usd REAL NOT NULL,
  most_overrun REAL NOT NULL, PRIMARY KEY (scope, driver)
) STRICT;
CREATE TABLE IF NOT EXISTS open (
  scope TEXT, call TEXT, attempt INTEGER, usd REAL NOT NULL, driver TEXT, slot TEXT,
  worst_usd REAL, since TEXT, outcome TEXT
) STRICT;
CREATE INDEX IF NOT EXISTS open_call ON open (call);
COMMIT;
PRAGMA journal_mode = wal;
PRAGMA synchronous = full; -- it survives a power cut
"""
_SPENT = "SELECT driver, usd, overrun_usd, most_overrun FROM spent WHERE scope = ?"
_RESERVED = "SELECT total(usd), count(*) FROM open WHERE scope = ?"
_OPEN = "INSERT INTO open VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?)"
_BEGUN = """
SELECT since FROM open WHERE call = ? AND attempt > ? AND outcome = 'in flight' ORDER BY attempt
"""
_IN_FLIGHT = "SELECT call, attempt, driver FROM open WHERE scope = ? AND outcome = 'in flight'"
_PAY = """
INSERT INTO spent VALUES (?, ?, ?, ?, ?) ON CONFLICT DO UPDATE SET usd = usd + excluded.usd,
overrun_usd = overrun_usd + excluded.overrun_usd,
most_overrun = max(most_overrun, excluded.most_overrun)
"""
_CLOSE = """
DELETE FROM open WHERE rowid =
(SELECT max(rowid) FROM open WHERE scope = ? AND call = ? AND attempt = ?)
RETURNING usd, driver, slot, worst_usd, since
"""
_REASONS = """
SELECT driver, outcome, count(*), sum(usd), min(since), max(since), min(slot) FROM open
WHERE scope = ? GROUP BY driver, outcome ORDER BY sum(usd) DESC
"""


def cost_usd(entry: ModelEntry, usage: Usage) -> float | None:
    """Return the cost of an attempt in USD, None where the price or the tokens are unknown."""
    price, read, written = entry.price, usage.input_tokens, usage.output_tokens
    if price == "free":
        return 0.0
    if read is None or written is None:
        return None
    cached = usage.cached_input_tokens or 0
    if cached > read:
        cached = 0  # the server counts wrongly: none is taken for cheap
    if isinstance(price, Price):
        cached_price = price.input if price.cached_input is None else price.cached_input
        parts = ((read - cached, price.input), (cached, cached_price), (written, price.output))
        # Decimals of the written figures, so that sums of costs have no digits that nobody wrote.
        return float(sum(n * Decimal(str(usd)) for n, usd in parts) / PER_MILLION)
    from genai_prices import Usage as PricedUsage  # here, since it takes long to load
    from genai_prices import calc_price

    priced = PricedUsage(input_tokens=read, cache_read_tokens=cached, output_tokens=written)
    provider = GENAI_PRICES_PROVIDER.get(entry.provider, entry.provider)
    try:
        found = calc_price(priced, model_ref=entry.id, provider_id=provider)
    except LookupError:
        return None
    return float(found.total_price)


@dataclass(frozen=True, slots=True)
class Asked:
    """Which driver at which endpoint is asked, for which slot, and the most that honestly costs."""

    driver: str = ""
    slot: str = ""
    honest_usd: float = 0.0


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


class LedgerFile:
    """The SQLite file with the money of all sweeps of a cache folder, made when it is needed."""

    def __init__(self, folder: Path) -> None:
        self._file = folder / FILE
        self._connections: dict[str, Connection] = {}
        self._one_at_a_time = RLock()
        self.writer = BatchWriter(self.run_now)

    def read(self, sql: str, *values: object) -> Rows:
        """Return the rows of a query; raises UsageError for a damaged file, and CacheFailed."""
        with self._told():
            # Its first transaction makes all tables: until then it is empty.
            if not self._connections and not (self._file.exists() and self._file.stat().st_size):
                return []
            return self._connection("ro").rows(sql, *values)

    def spending(self, scope: str, ask: Callable[..., Rows]) -> Spending:
        """Return the sums of a sweep, by ``read`` or ``write``; raises UsageError for odd ones."""
        with self._told():
            # What is reserved first: what is settled meanwhile counts twice rather than never.
            ((reserved_usd, attempts),) = ask(_RESERVED, scope) or [(0.0, 0)]
            spent = ask(_SPENT, scope)
            spent_usd, overrun_usd = (sum((r[column] for r in spent), 0.0) for column in (1, 2))
            if not (spent_usd >= 0 and reserved_usd >= 0):
                raise sqlite3.IntegrityError("no sweep can have spent that")
        overruns = {driver: most for driver, _, _, most in spent if most > 0}
        return Spending(spent_usd, reserved_usd, attempts, overrun_usd, overruns)

    def write(self, sql: str, *values: object) -> Rows:
        """Execute a statement within a transaction, and return its rows."""
        return self._connection("rwc").rows(sql, *values)

    @contextlib.contextmanager
    def transaction(self) -> Iterator[None]:
        """Make what is written within it, in this thread, one durable transaction."""
        with self._told(), self._one_at_a_time:
            connection = self._connection("rwc")
            if connection.in_transaction:  # a part of the one around it
                yield
                return
            with connection:
                connection.execute("BEGIN IMMEDIATE")
                yield

    def run_now(self, operations: list[Operation]) -> list[Any]:
        """Run operations in one durable transaction, in this thread; raises UsageError."""
        with self.transaction():
            return [operation() for operation in operations]

    def begun(self, call: str, tried: int) -> Iterator[Attempt]:
        """Yield the attempts at a call, beyond those ``tried``, whose end nobody has seen."""
        rows: Rows = []
        with contextlib.suppress(UsageError, CacheFailed):  # told before anything is paid
            rows = self.read(_BEGUN, call, tried)
        for number, (since,) in enumerate(rows, tried + 1):
            why = "the run ended before a reply was seen; it may have been charged"
            yield Attempt(number, "unknown", started_at=since, error=why)

    def close(self) -> None:
        """Close the file."""
        while self._connections:
            self._connections.popitem()[1].close()

    def _connection(self, mode: str) -> Connection:
        """Return a connection of its own to read or write: the event loop reads while one syncs."""
        if mode not in self._connections:
            connection = connect(self._file, mode)
            if mode == "rwc":
                with making(self._file.parent):
                    connection.executescript(TABLES)
            self._connections[mode] = connection  # not before: the event loop reads meanwhile
        return self._connections[mode]

    @contextlib.contextmanager
    def _told(self) -> Iterator[None]:
        try:
            yield
        except sqlite3.Error as exc:
            if isinstance(exc, sqlite3.OperationalError) and "no such" not in str(exc):
                raise CacheFailed(
                    f"{self._file} cannot be written: {exc}. When that is mended, run the same "
                    "command again"
                ) from exc
            raise UsageError(
                f"the record of what sweeps have spent ({self._file}) cannot be used, so that no "
                f"cap could hold ({exc}): put a copy of it back, or take the replies with "
                f"`merge-runner recording import {self._file.parent} --cache NEW`, and go on with "
                "--cache NEW, which counts from 0"
            ) from exc


def scopes(cache: ResponseCache) -> list[str]:
    """Return the names of all ledgers in a cache."""
    rows = cache.money.read("SELECT scope FROM spent UNION SELECT scope FROM open ORDER BY 1")
    return [scope for (scope,) in rows]


class Ledger:
    """The spending of one sweep; ``scope`` names it in the file. ``spending`` is its last state.

    Several processes may run the sweep: every change sums anew. The ledger of a model that costs
    nothing has no name, and keeps no record.
    """

    def __init__(self, cache: ResponseCache, scope: str) -> None:
        self.spending = Spending()
        self.scope = scope
        self.cache = cache
        self._money = cache.money
        # A damaged record is an error only where money is to be spent: a replay needs none.
        with contextlib.suppress(UsageError, CacheFailed):
            self.read()

    def read(self) -> Spending:
        """Return the current state; raises UsageError where its record is damaged."""
        if self.scope:
            self.spending = self._money.spending(self.scope, self._money.read)
        return self.spending

    def reserve(
        self, key: str, number: int, usd: float, cap_usd: float | None, asked: Asked
    ) -> bool:
        """Reserve the worst case of an attempt at a call; False if that exceeds the cap."""
        if not self.scope:
            return True
        with self._money.transaction():
            committed_usd = self._money.spending(self.scope, self._money.write).committed_usd
            if cap_usd is not None and committed_usd + usd > cap_usd + TOLERANCE_USD:
                return False
            since = datetime.now(UTC).isoformat(timespec="milliseconds")
            place = (asked.driver, asked.slot, asked.honest_usd, since, "in flight")
            self._money.write(_OPEN, self.scope, key, number, usd, *place)
        return True

    def aside_usd(self, key: str) -> float:
        """Return the USD reserved for the last attempt at a call; 0 where nothing is."""
        sql = "SELECT usd FROM open WHERE scope = ? AND call = ? ORDER BY attempt DESC LIMIT 1"
        rows = self._money.read(sql, self.scope, key)
        return float(rows[0][0]) if rows else 0.0

    async def settle(self, key: str, attempt: Attempt, driver: str) -> None:
        """Settle an attempt at a call; its reservation stays where the cost is unknown."""
        if self.scope:
            await self._money.writer.write(partial(self._settled, key, attempt, driver))
            self.read()

    def _settled(self, key: str, attempt: Attempt, driver: str) -> None:
        place, cost_usd, over = (self.scope, key, attempt.number), attempt.cost_usd, (0.0, 0.0)
        # It may be gone: a batch may end after its money was released.
        for row in self._money.write(_CLOSE, *place):
            if cost_usd is None:  # it may have been charged
                self._money.write(_OPEN, *place, *row, attempt.outcome)
            elif cost_usd > row[0] + TOLERANCE_USD:
                over = (cost_usd - row[0], cost_usd / max(row[3], TOLERANCE_USD))
        if cost_usd is not None:
            self._money.write(_PAY, self.scope, driver, cost_usd, *over)

    def settle_kept(self, drivers: Collection[str]) -> None:
        """Settle attempts that were kept right before their run was killed.

        No other run may ask these drivers meanwhile.
        """
        rows = self._money.read(_IN_FLIGHT, self.scope)
        for key, number, driver in (row for row in rows if row[2] in drivers):
            with contextlib.suppress(RecordingError):
                entry = self.cache.get(key)
                for attempt in entry.attempts if entry else self.cache.unanswered(key):
                    if attempt.number == number and attempt.outcome != "unknown":
                        self._money.run_now([partial(self._settled, key, attempt, driver)])

    def rows(self) -> tuple[Rows, Rows]:
        """Return the rows of what is spent and of what is open, for ``settle_share``."""
        opened = self._money.read("SELECT * FROM open WHERE scope = ?", self.scope)
        return self._money.read(_SPENT, self.scope), [row[1:] for row in opened]

    def settle_share(self, name: str, spent: Rows, opened: Rows) -> None:
        """Put what a task has spent, and has open, in the place of the share reserved for it."""
        with self._money.transaction():
            self._money.write("DELETE FROM open WHERE scope = ? AND call = ?", self.scope, name)
            for sql, rows in ((_PAY, spent), (_OPEN, opened)):
                for row in rows:
                    self._money.write(sql, self.scope, *row)

    def reasons(self) -> list[dict[str, Any]]:
        """Return the reservations by driver and outcome, with times in UTC and one of the slots."""
        names = ("driver", "outcome", "attempts", "usd", "first", "last", "slot")
        return [dict(zip(names, r, strict=True)) for r in self._money.read(_REASONS, self.scope)]

    def release(self) -> None:
        """Count no longer what is reserved; nobody may be asking meanwhile."""
        with self._money.transaction():
            self._money.write("DELETE FROM open WHERE scope = ?", self.scope)
        self.read()
