"""What sweeps have spent, what is set aside and why, and its release: `merge-runner ledger`."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from merge_runner.errors import UsageError, unknown_name
from merge_runner.llm.cache import ResponseCache
from merge_runner.llm.ledger import IN_FLIGHT, UNRECORDED, Ledger, Reason, Release, Spending, scopes

MEANING = {
    IN_FLIGHT: "in flight now, or when a run was killed",
    UNRECORDED: "the note of the reason is damaged",
}


@dataclass(frozen=True, slots=True)
class Account:
    """The ledger of one sweep, by its name: sweep, model and sample set."""

    sweep: str
    spending: Spending
    reasons: list[Reason]

    def as_dict(self) -> dict[str, Any]:
        """The account as JSON values."""
        reasons = [asdict(reason) for reason in self.reasons]
        return {"sweep": self.sweep, **asdict(self.spending), "reasons": reasons}

    def lines(self) -> Iterator[str]:
        """The account for a reader."""
        spending = self.spending
        yield (
            f"{self.sweep}: {spending.spent_usd:.4f} USD spent, {spending.reserved_usd:.4f} set "
            f"aside for {spending.open_attempts} attempts whose cost is not known"
        )
        for reason in self.reasons:
            yield f"  {reason.usd:.4f} USD for {_reason_text(reason)}"
        if spending.overrun_usd:
            yield (
                f"  {spending.overrun_usd:.4f} of what is spent is what replies cost more than "
                f"their worst case: {spending.dearest}"
            )
        for release in spending.releases:
            yield f"  {release.usd:.4f} USD were released on {release.at}: {_release_text(release)}"


def accounts(folder: Path) -> list[Account]:
    """All ledgers of a cache folder; raises UsageError where there is none."""
    with _opened(folder, read_only=True) as cache:
        return [_account(cache, scope) for scope in scopes(cache)]


def account(folder: Path, sweep: str) -> Account:
    """The ledger of one sweep; raises UsageError for one that is not there."""
    found = {each.sweep: each for each in accounts(folder)}
    if sweep not in found:
        raise unknown_name("sweep", sweep, found, f"with a ledger in {folder}")
    return found[sweep]


def release(folder: Path, sweep: str) -> Account:
    """Stop counting what is set aside for a sweep. Raises UsageError while a run is asking."""
    account(folder, sweep)
    with _opened(folder) as cache:
        if not cache.locks.take_all():
            raise UsageError(
                f"another merge-runner works with {folder}: what it has in flight cannot be "
                "released; try again when it has ended"
            )
        Ledger(cache, sweep).release()
        return _account(cache, sweep)


@contextmanager
def _opened(folder: Path, *, read_only: bool = False) -> Iterator[ResponseCache]:
    if not (folder / "cache.db").is_file():
        raise UsageError(f"there is no cache in {folder}, so nothing was spent: name it by --cache")
    cache = ResponseCache(folder, read_only=read_only)
    try:
        yield cache
    finally:
        cache.close()


def _account(cache: ResponseCache, scope: str) -> Account:
    ledger = Ledger(cache, scope)
    return Account(scope, ledger.read(), ledger.reasons())


def _reason_text(reason: Reason) -> str:
    what = MEANING.get(reason.outcome, reason.outcome)
    where = f" of {reason.driver}" if reason.driver else ""
    when = f", {reason.first} to {reason.last}" if reason.first else ""
    slots = f" (as {'; '.join(filter(None, reason.slots))})" if any(reason.slots) else ""
    return f"{reason.attempts} attempts{where}: {what}{when}{slots}"


def _release_text(release: Release) -> str:
    return "; ".join(map(_reason_text, release.reasons)) or "nothing"
