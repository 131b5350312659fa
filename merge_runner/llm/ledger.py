"""The money of sweeps: what attempts cost, what is reserved, and a cap that holds over all runs.

What tokens cost is told by the registry's figures, or by the table of genai-prices.

The worst case of an attempt is reserved when it queues for its turn, and durably, in one
transaction that sums what is spent and open, right before it is sent; see PaidAttempt. A process
that dies leaves its reservations: the next run settles what is kept already; any other attempt
counts with its worst case until a user releases it, and is listed with an unknown outcome.

So that money finishes trials instead of beginning ever more of them, a trial begins only where what
it is expected to cost fits beside what the trials that have begun are still expected to cost.
Expectations err, so an attempt leaves room for what older trials need, and for no younger one's:
the oldest trial is suspended only where all the money left does not pay for a single attempt.

A server may ignore the output cap. What a reply cost beyond its worst case is taken from what is
left, and from then on the worst case is multiplied by as much as that driver's most expensive reply
exceeded it. Several attempts are in flight only while twice their worst cases fit, so that one
reply at most, the last one, can pass the cap.
"""

from __future__ import annotations

import asyncio
import bisect
import contextlib
import json
import sqlite3
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from decimal import Decimal
from functools import partial
from operator import itemgetter
from pathlib import Path
from threading import Lock, RLock
from typing import Any

from merge_runner.config import ModelEntry, Price
from merge_runner.errors import CacheFailed, RecordingError, TrialSuspended, UsageError
from merge_runner.llm.durable import BatchWriter, Operation, alone, connect, each_or_alone, making
from merge_runner.records import Attempt, Usage

FILE = "ledger.db"
TOLERANCE_USD = 1e-9  # sums of floats
# An older trial that has money kept for it may wait for a call of a younger one, which waits for
# money: after this long, with nothing in flight, it is no longer counted on.
PATIENCE_S = 90.0
# The provider names of genai-prices where they differ from ours.
GENAI_PRICES_PROVIDER = {"gemini": "google"}
PER_MILLION = Decimal(1_000_000)
Rows = list[tuple[Any, ...]]
USED_UP = "others under the same cap have used it up"
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
_SPENT = "SELECT driver, usd, overrun_usd, most_overrun FROM spent WHERE scope = ?1"
# In one statement: what is settled meanwhile is in the one or in the other sum.
_SUMS = f"SELECT NULL, total(usd), count(*), 0 FROM open WHERE scope = ?1 UNION ALL {_SPENT}"  # noqa: S608
_COMMITTED = """
SELECT total(usd) FROM (SELECT scope, usd FROM open UNION ALL SELECT scope, usd FROM spent)
WHERE scope IN (SELECT value FROM json_each(?))
"""
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


# What is billed at more than the plain price, about twice at OpenAI.
DEARER_TIERS = frozenset({"priority"})


def cost_usd(entry: ModelEntry, usage: Usage, tier: str | None = None) -> float | None:
    """Return the cost of an attempt in USD, None where the price or the tokens are unknown.

    ``tier`` is the service tier that the reply names; one without a price of its own is priced as
    the plain one.
    """
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
        plain = sum(n * Decimal(str(usd)) for n, usd in parts) / PER_MILLION
        return float(plain * Decimal(str(price.tiers.get(tier or "", 1))))
    from genai_prices import Usage as PricedUsage  # here, since it takes long to load
    from genai_prices import calc_price

    priced = PricedUsage(input_tokens=read, cache_read_tokens=cached, output_tokens=written)
    provider = GENAI_PRICES_PROVIDER.get(entry.provider, entry.provider)
    calculate = partial(calc_price, priced, model_ref=entry.id, provider_id=provider)
    try:
        # Older versions of the package know no tiers.
        with contextlib.suppress(TypeError):
            if tier is not None:
                return float(calculate(price_context={"service_tier": tier}).total_price)
        return float(calculate().total_price)
    except LookupError:
        return None


def is_underpriced(entry: ModelEntry, tier: str | None) -> bool:
    """Return whether a reply of this tier costs more than the registry knows."""
    if tier not in DEARER_TIERS:
        return False
    million = Usage(1_000_000, 0, 1_000_000)
    plain_usd = cost_usd(entry, million)
    return bool(plain_usd) and cost_usd(entry, million, tier) == plain_usd


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


class LedgerFile:
    """The SQLite file with the money of all sweeps of a cache folder, made when it is needed."""

    def __init__(self, folder: Path) -> None:
        self._file = folder / FILE
        self._connections: dict[str, sqlite3.Connection] = {}
        self._one_query, self._one_writer = Lock(), RLock()
        self.writer = BatchWriter(self._run_each)

    def read(self, sql: str, *values: object) -> Rows:
        """Return the rows of a query; raises UsageError for a damaged file, and CacheFailed."""
        try:
            with self._one_query:
                if not (self._connections or self._has_tables()):
                    return []
                return self._connection("ro").execute(sql, values).fetchall()
        except sqlite3.Error as exc:
            raise self._unusable(exc) from exc

    def spending(self, scope: str, ask: Callable[..., Rows]) -> Spending:
        """Return the sums of a sweep, by ``read`` or ``write``; raises UsageError for odd ones."""
        (_, reserved_usd, attempts, _), *spent = ask(_SUMS, scope) or [(None, 0.0, 0, 0)]
        spent_usd = overrun_usd = 0.0
        overruns = {}
        for driver, usd, over_usd, most in spent:
            spent_usd += usd
            overrun_usd += over_usd
            if most > 0:
                overruns[driver] = most
        if not (spent_usd >= 0 and reserved_usd >= 0):
            raise self._unusable(sqlite3.IntegrityError("no sweep can have spent that"))
        return Spending(spent_usd, reserved_usd, attempts, overrun_usd, overruns)

    def write(self, sql: str, *values: object) -> Rows:
        """Execute a statement, and return its rows; an operation."""
        try:
            with self._one_writer:
                return self._connection("rwc").execute(sql, values).fetchall()
        except sqlite3.Error as exc:
            raise self._unusable(exc) from exc

    def run_now(self, operations: list[Operation]) -> list[Any]:
        """Run operations in one durable transaction, in this thread; raises UsageError."""
        try:
            with self._one_writer, self._connection("rwc") as connection:
                connection.execute("BEGIN IMMEDIATE")
                return [operation() for operation in operations]
        except sqlite3.Error as exc:
            raise self._unusable(exc) from exc

    def _run_each(self, operations: list[Operation]) -> list[Any]:
        """Run operations in one durable transaction, each with its result or its own error."""
        return each_or_alone(self.run_now, partial(alone, self.write), operations)

    def begun(self, call: str, tried: int) -> Iterator[Attempt]:
        """Yield the attempts at a call, beyond those ``tried``, whose end nobody has seen."""
        why = "the run ended before a reply was seen; it may have been charged"
        with contextlib.suppress(UsageError, CacheFailed):  # told before anything is paid
            for number, (since,) in enumerate(self.read(_BEGUN, call, tried), tried + 1):
                yield Attempt(number, "unknown", started_at=since, error=why)

    def close(self) -> None:
        """Close the file."""
        while self._connections:
            self._connections.popitem()[1].close()

    def _has_tables(self) -> bool:
        """Return whether there is a file with tables: its first transaction makes them all."""
        if not self._file.exists():
            return False
        if self._file.with_name(f"{FILE}-journal").exists():
            # Of a process that was killed in it: who may only read cannot take its pages back.
            with contextlib.closing(connect(self._file, "rw")) as recovering:
                recovering.execute("SELECT 1 FROM sqlite_schema").fetchall()
        return self._file.stat().st_size > 0

    def _connection(self, mode: str) -> sqlite3.Connection:
        """Return a connection of its own to read or write: the event loop reads while one syncs."""
        if mode not in self._connections:
            connection = connect(self._file, mode)
            if mode == "rwc":
                with making(self._file.parent):
                    connection.executescript(TABLES)
            self._connections[mode] = connection  # not before: the event loop reads meanwhile
        return self._connections[mode]

    def _unusable(self, why: sqlite3.Error) -> CacheFailed | UsageError:
        """Return the error of a file that cannot be written, or is damaged."""
        if isinstance(why, sqlite3.OperationalError) and "no such" not in str(why):
            return CacheFailed(
                f"{self._file} cannot be written: {why}. When that is mended, run the same "
                "command again"
            )
        return UsageError(
            f"the record of what sweeps have spent ({self._file}) cannot be used, so that no "
            f"cap could hold ({why}): put a copy of it back, or take the replies with "
            f"`merge-runner recording import {self._file.parent} --cache NEW`, and go on with "
            "--cache NEW, which counts from 0"
        )


def scopes(money: LedgerFile) -> list[str]:
    """Return the names of all ledgers in a file."""
    rows = money.read("SELECT scope FROM spent UNION SELECT scope FROM open ORDER BY 1")
    return [scope for (scope,) in rows]


class Ledger:
    """The spending of one sweep; ``scope`` names it in the file. ``spending`` is its last state.

    Several processes may run the sweep: every change sums anew. The ledger of a model that costs
    nothing has no name, and keeps no record. What ``others`` hold counts under the same cap.
    """

    def __init__(self, money: LedgerFile, scope: str, others: Sequence[str] = ()) -> None:
        self.spending = Spending()
        self.scope = scope
        self._others, self._elsewhere_usd = json.dumps(others), 0.0
        self._money = money
        # A damaged record is an error only where money is to be spent: a replay needs none.
        with contextlib.suppress(UsageError, CacheFailed):
            self.read()

    def read(self) -> Spending:
        """Return the current state; raises UsageError where its record is damaged."""
        if self.scope:
            self.spending = self._money.spending(self.scope, self._money.read)
            self._elsewhere_usd = self._committed_elsewhere(self._money.read)
        return self.spending

    @property
    def committed_usd(self) -> float:
        """The most that may have been spent under the cap, as last read."""
        return self.spending.committed_usd + self._elsewhere_usd

    def _committed_elsewhere(self, ask: Callable[..., Rows]) -> float:
        if self._others == "[]":
            return 0.0
        return sum((float(usd) for (usd,) in ask(_COMMITTED, self._others)), 0.0)

    def reserve(
        self, key: str, number: int, usd: float, cap_usd: float | None, asked: Asked
    ) -> bool:
        """Reserve the worst case of an attempt; False if that exceeds the cap; an operation."""
        if not self.scope:
            return True
        committed_usd = self._money.spending(self.scope, self._money.write).committed_usd
        committed_usd += self._committed_elsewhere(self._money.write)
        if cap_usd is not None and committed_usd + usd > cap_usd + TOLERANCE_USD:
            return False
        since = datetime.now(UTC).isoformat(timespec="milliseconds")
        place = (asked.driver, asked.slot, asked.honest_usd, since, "in flight")
        self._money.write(_OPEN, self.scope, key, number, usd, *place)
        return True

    async def ask(self, key: str, usd: float, asked: Asked) -> bool:
        """Return whether there is money for an attempt where others share the cap out."""
        return True

    def withdraw(self, key: str) -> None:
        """Say there that the attempt at a call is not sent."""

    async def begin(
        self, key: str, number: int, usd: float, cap_usd: float | None, asked: Asked
    ) -> bool:
        """Make the reservation of an attempt durable; False if that exceeds the cap."""
        worst = partial(self.reserve, key, number, usd, cap_usd, asked)
        return not self.scope or bool(await self._money.writer.write(worst))

    async def settle(self, key: str, attempt: Attempt, driver: str) -> None:
        """Settle an attempt at a call; its reservation stays where the cost is unknown."""
        if self.scope:
            await self._money.writer.write(partial(self._settled, key, attempt, driver))
            self.read()

    def _settled(self, key: str, attempt: Attempt, driver: str) -> None:
        if attempt.cost_usd is None:  # it may have been charged
            self._money.write(_KEEP, attempt.outcome, key, attempt.number)
        else:
            self.pay(key, attempt.number, attempt.cost_usd, driver)

    def pay(self, key: str, number: int, usd: float, driver: str) -> tuple[str, float, float]:
        """Count what an attempt has cost as spent, no longer its worst case; an operation.

        Returns the driver, the cost, and by how much that exceeds the worst case.
        """
        over = (0.0, 0.0)
        closed = self._money.write(_CLOSE, key, number)
        # None: a user has released it. That of a line is of the sweep that has submitted its batch.
        scope, aside_usd, honest_usd = closed[0] if closed else (self.scope, usd, usd)
        if usd > aside_usd + TOLERANCE_USD:
            over = (usd - aside_usd, usd / max(honest_usd, TOLERANCE_USD))
        self._money.write(_PAY, scope, driver, usd, *over)
        return driver, usd, over[0]

    def settle_kept(
        self, drivers: Collection[str], kept: Callable[[str], Iterable[Attempt]]
    ) -> None:
        """Settle what was ``kept`` right before a run of these drivers was killed; none goes on."""
        rows = self._money.read(_IN_FLIGHT, self.scope)
        for key, number, driver in (row for row in rows if row[2] in drivers):
            with contextlib.suppress(RecordingError):
                for attempt in kept(key):
                    if attempt.number == number and attempt.outcome != "unknown":
                        self._money.run_now([partial(self._settled, key, attempt, driver)])

    def reserved_usd(self, key: str) -> float:
        """Return the USD reserved for the last attempt at a call; 0: a user has released them."""
        rows = self._money.read("SELECT usd FROM open WHERE call = ? ORDER BY attempt", key)
        return float(rows[-1][0]) if rows else 0.0

    def rows(self) -> tuple[Rows, Rows]:
        """Return the rows of what is spent and of what is open, for ``settle_share``."""
        opened = self._money.read("SELECT * FROM open WHERE scope = ?", self.scope)
        return self._money.read(_SPENT, self.scope), [row[1:] for row in opened]

    def settle_share(self, name: str, spent: Rows, opened: Rows) -> None:
        """Count what a task has spent and has open, no longer what is reserved by its name."""
        sql = "DELETE FROM open WHERE scope = ? AND call = ?"
        operations: list[Operation] = [partial(self._money.write, sql, self.scope, name)]
        operations += [partial(self._money.write, _PAY, self.scope, *row) for row in spent]
        operations += [partial(self._money.write, _OPEN, self.scope, *row) for row in opened]
        self._money.run_now(operations)

    def reasons(self) -> list[dict[str, Any]]:
        """Return the reservations by driver and outcome, with times in UTC and one of the slots."""
        names = ("driver", "outcome", "attempts", "usd", "first", "last", "slot")
        return [dict(zip(names, r, strict=True)) for r in self._money.read(_REASONS, self.scope)]

    def release(self) -> None:
        """Count no longer what is reserved; nobody may be asking meanwhile."""
        self._money.write("DELETE FROM open WHERE scope = ?", self.scope)
        self.read()


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
        if not await ledger.begin(self.key, number, self.aside_usd, cap_usd, self.asked):
            raise TrialSuspended(USED_UP)
        self.queued = False
        self.budget.queued_usd -= self.aside_usd

    async def settle(self, attempt: Attempt) -> None:
        """Settle what the attempt cost, when it is kept."""
        await self.budget.ledger.settle(self.key, attempt, self.asked.driver)
        self.cost_usd = attempt.cost_usd

    def close(self) -> None:
        """Give back what the attempt, which has ended, did not spend."""
        self.budget.in_flight -= 1
        if self.queued:
            self.budget.queued_usd -= self.aside_usd
            self.cost_usd = 0.0
            self.budget.ledger.withdraw(self.key)
        if self.cost_usd is not None:
            self.budget.charge(self.trial, self.cost_usd - self.aside_usd)
        self.budget.wake()


class Budget:
    """Spending under a cap in USD; without one nothing is refused, and all of it recorded.

    A trial is named by its order in the sweep; ``trial_usd`` returns the USD that one is expected
    to cost. ``in_flight`` counts the attempts that have money, ``queued_usd`` is reserved in this
    process alone.
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
        self._charged_usd: dict[int, float] = {}  # by trial that has begun, with reservations
        self._left: set[int] = set()
        # The lowest place first: attempts come before trials that wait to begin, and older trials,
        # of a lower order, before younger ones.
        self._queue: list[tuple[tuple[bool, int], asyncio.Event]] = []

    async def admit(self, trial: int) -> None:
        """Wait until a trial may begin; raises TrialSuspended when no trial's end can let it."""
        if self.cap_usd is not None and trial not in self._charged_usd:
            await self._in_turn((True, trial), lambda _: self._begins(trial))

    def begin_anew(self, trial: int) -> None:
        """Admit a trial at once: it goes on where an earlier run has asked for it."""
        if self.cap_usd is not None and trial not in self._left:
            self._charged_usd.setdefault(trial, 0.0)

    def leave(self, trial: int) -> None:
        """Free the money of a trial that has ended or is suspended."""
        self._left.add(trial)
        if self._charged_usd.pop(trial, None) is not None:
            self.wake()

    async def set_aside(self, trial: int, key: str, asked: Asked) -> PaidAttempt:
        """Reserve an attempt's worst case, more where its server ignores the output cap.

        Waits while other attempts or older trials may free money, then raises TrialSuspended. The
        caller closes what is returned.
        """
        if self.cap_usd is not None:
            await self._in_turn((False, trial), partial(self._pays, trial, asked))
        usd = self._worst_usd(asked)
        self._largest_usd = max(self._largest_usd, usd)
        return PaidAttempt(self, trial, key, asked, usd)

    def going_on(self, trial: int, key: str, asked: Asked) -> PaidAttempt:
        """Return the money of an attempt that an earlier run, perhaps another sweep, has begun."""
        aside_usd = self.ledger.reserved_usd(key)
        return PaidAttempt(self, trial, key, asked, aside_usd, queued=False)

    def charge(self, trial: int, usd: float) -> None:
        """Count what a trial that has begun spends or sets aside, or gives back."""
        if trial in self._charged_usd:
            self._charged_usd[trial] += usd

    def wake(self) -> None:
        """Let the first in the queue see whether it may go on by now."""
        if self._queue:
            self._queue[0][1].set()

    def _begins(self, trial: int) -> bool:
        """Begin a trial if there is money for it beside all that have begun."""
        if trial in self._left:
            raise TrialSuspended("its trial is suspended")
        if trial in self._charged_usd:  # its other driver stood in the queue, too
            return True
        needed_usd, left_usd = self.trial_usd(trial), self._left_usd()
        if left_usd < needed_usd and not self._charged_usd and not self.in_flight:
            # The first one that asks begins all the same: it may cost less, and each attempt must
            # still fit.
            if self._spent_before or self._largest_usd:
                raise self._suspended(f"a whole trial may cost {needed_usd:.2f} USD")
        elif left_usd < needed_usd + self._needed_usd(self._charged_usd):
            return False
        self._charged_usd[trial] = 0.0
        return True

    def _pays(self, trial: int, asked: Asked, waited_s: float) -> bool:
        """Return whether there is money for an attempt."""
        left_usd = self._left_usd()  # reads what the worst case is by now
        worst_usd = self._worst_usd(asked)
        if left_usd < worst_usd and not self.in_flight:
            raise self._suspended(f"the next call may cost {worst_usd:.4f} USD")
        counted_on = self.in_flight or waited_s < PATIENCE_S
        older = (each for each in self._charged_usd if each < trial and counted_on)
        # A server that ignores the output cap is known only by its first expensive reply, when the
        # others are sent already: all in flight may cost twice as much.
        twice_usd = (self.in_flight + 1) * max(worst_usd, self._largest_usd)
        return left_usd - worst_usd >= max(
            self._needed_usd(older), twice_usd if self.in_flight else 0.0
        )

    def _worst_usd(self, asked: Asked) -> float:
        """Return the worst case, scaled by this driver's largest observed cost overrun."""
        return asked.honest_usd * self.ledger.spending.overruns.get(asked.driver, 1.0)

    def _left_usd(self) -> float:
        assert self.cap_usd is not None
        self.ledger.read()
        return self.cap_usd - self.ledger.committed_usd - self.queued_usd + TOLERANCE_USD

    def _needed_usd(self, trials: Iterable[int]) -> float:
        """Return what these begun trials are still expected to cost."""
        return sum(max(0.0, self.trial_usd(each) - self._charged_usd[each]) for each in trials)

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
                with contextlib.suppress(TimeoutError):
                    async with asyncio.timeout(PATIENCE_S):
                        await changed.wait()
        finally:
            self._queue.remove(own)
            self.wake()

    def _suspended(self, what: str) -> TrialSuspended:
        """Return the error of a trial that cannot be paid."""
        spending, kept_usd = self.ledger.spending, self._needed_usd(self._charged_usd)
        reserved_usd = spending.reserved_usd + self.queued_usd
        elsewhere_usd = self.ledger.committed_usd - spending.committed_usd
        elsewhere = f", {elsewhere_usd:.4f} by others under this cap" if elsewhere_usd else ""
        total_usd = self.ledger.committed_usd + self.queued_usd
        return TrialSuspended(
            f"{what}, and {total_usd:.4f} of {self.cap_usd:g} USD are "
            f"spent or set aside ({spending.spent_usd:.4f} spent, {reserved_usd:.4f} set aside for "
            f"{spending.open_attempts} attempts whose cost is not known{elsewhere}: "
            "`merge-runner ledger`); "
            f"{kept_usd:.4f} more are kept for the trials that have begun"
        )
