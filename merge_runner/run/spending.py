"""What sweeps have spent, what is reserved and why, and its release: `merge-runner ledger`."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import closing
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from merge_runner.errors import UsageError, unknown_name
from merge_runner.llm.cache import ResponseCache
from merge_runner.llm.ledger import IN_FLIGHT, Ledger, Reason, Spending, scopes


@dataclass(frozen=True, slots=True)
class Account:
    """The ledger of one sweep, by its name: sweep, model and sample set."""

    sweep: str
    spending: Spending
    reasons: list[Reason]

    def as_dict(self) -> dict[str, Any]:
        """Return the account as JSON values."""
        reasons = [asdict(reason) for reason in self.reasons]
        return {"sweep": self.sweep, **asdict(self.spending), "reasons": reasons}

    def lines(self) -> Iterator[str]:
        """Yield the account in lines for a reader."""
        spending = self.spending
        yield (
            f"{self.sweep}: {spending.spent_usd:.4f} USD spent, {spending.reserved_usd:.4f} set "
            f"aside for {spending.open_attempts} attempts whose cost is not known"
        )
        for each in self.reasons:
            what = each.outcome
            if what == IN_FLIGHT:
                what = "in flight now, or when a run was killed"
            where = f" of {each.driver}" if each.driver else ""
            slot = f" (as {each.slot})" if each.slot else ""
            yield (
                f"  {each.usd:.4f} USD for {each.attempts} attempts{where}: {what}, {each.first} "
                f"to {each.last}{slot}"
            )
        if spending.overrun_usd:
            yield (
                f"  {spending.overrun_usd:.4f} of what is spent is what replies cost more than "
                f"their worst case: {spending.dearest}"
            )


def accounts(folder: Path) -> list[Account]:
    """Return all ledgers of a cache folder; raises UsageError where there is none."""
    if not (folder / "cache.db").is_file():
        raise UsageError(f"there is no cache in {folder}, so nothing was spent: name it by --cache")
    with closing(ResponseCache(folder, read_only=True)) as cache:
        ledgers = [Ledger(cache, scope) for scope in scopes(cache)]
        return [Account(each.scope, each.read(), each.reasons()) for each in ledgers]


def account(folder: Path, sweep: str) -> Account:
    """Return the ledger of one sweep; raises UsageError for one that is not there."""
    found = {each.sweep: each for each in accounts(folder)}
    if sweep not in found:
        raise unknown_name("sweep", sweep, found, f"with a ledger in {folder}")
    return found[sweep]


def release(folder: Path, sweep: str) -> Account:
    """Stop counting what is reserved for a sweep. Raises UsageError while a run is asking."""
    with closing(ResponseCache(folder)) as cache:
        if not cache.locks.take_all():
            raise UsageError(
                f"another merge-runner works with {folder}: what it has in flight cannot be "
                "released; try again when it has ended"
            )
        Ledger(cache, sweep).release()
    return account(folder, sweep)
