"""The command that shows what was spent and what is reserved, and releases it."""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import closing
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any

import typer

from merge_runner.cli.options import CacheOption, JsonOption
from merge_runner.cli.output import agree, print_out
from merge_runner.errors import UsageError, unknown_name
from merge_runner.paths import DEFAULT_CACHE


def ledger(
    cache: CacheOption = DEFAULT_CACHE,
    release: Annotated[
        str | None,
        typer.Option("--release", metavar="SWEEP", help="Stop counting what is set aside."),
    ] = None,
    yes: Annotated[bool, typer.Option("--yes", help="Do not ask before releasing.")] = False,
    as_json: JsonOption = False,
) -> None:
    """Show what each sweep has spent, and what is set aside."""
    accounts = _accounts(cache)
    if release is not None:
        if release not in accounts:
            raise unknown_name("sweep", release, accounts, f"with a ledger in {cache}")
        open_ones = accounts[release]
        agree(
            f"{open_ones['reserved_usd']:.4f} USD are set aside for {open_ones['open_attempts']} "
            f"attempts at {release}. If the provider did charge for them, --max-cost may be "
            "passed by as much",
            "Release it?",
            otherwise="nothing was released",
            yes=yes,
        )
        _release(cache, release)
        accounts = {name: each for name, each in _accounts(cache).items() if name == release}
    if as_json:
        print_out(json.dumps([*accounts.values()], ensure_ascii=False))
        return
    for account in accounts.values():
        for line in _lines(account):
            print_out(line)
    if not accounts:
        print_out("No sweep has spent anything.")


def _accounts(folder: Path) -> dict[str, dict[str, Any]]:
    """Return all ledgers of a cache folder by sweep, as JSON values; raises UsageError."""
    from merge_runner.llm.cache import ResponseCache
    from merge_runner.llm.ledger import Ledger, scopes

    if not (folder / "cache.db").is_file():
        raise UsageError(f"there is no cache in {folder}, so nothing was spent: name it by --cache")
    with closing(ResponseCache(folder, read_only=True)) as cache:
        ledgers = [Ledger(cache, scope) for scope in scopes(cache)]
        return {
            each.scope: {"sweep": each.scope, **asdict(each.read()), "reasons": each.reasons()}
            for each in ledgers
        }


def _release(folder: Path, sweep: str) -> None:
    from merge_runner.llm.cache import ResponseCache
    from merge_runner.llm.ledger import Ledger

    with closing(ResponseCache(folder)) as cache:
        if not cache.locks.take_all():
            raise UsageError(
                f"another merge-runner works with {folder}: what it has in flight cannot be "
                "released; try again when it has ended"
            )
        Ledger(cache, sweep).release()


def _lines(account: dict[str, Any]) -> Iterator[str]:
    """Yield an account in lines for a reader."""
    yield (
        f"{account['sweep']}: {account['spent_usd']:.4f} USD spent, "
        f"{account['reserved_usd']:.4f} set aside for {account['open_attempts']} attempts whose "
        "cost is not known"
    )
    for each in account["reasons"]:
        killed = " now, or when a run was killed" if each["outcome"] == "in flight" else ""
        yield (
            f"  {each['usd']:.4f} USD for {each['attempts']} attempts of {each['driver']}: "
            f"{each['outcome']}{killed}, {each['first']} to {each['last']} (as {each['slot']})"
        )
    if account["overrun_usd"]:
        ratios = account["overruns"].items()
        told = ", ".join(f"{driver} up to {ratio:.2f} times as much" for driver, ratio in ratios)
        yield (
            f"  {account['overrun_usd']:.4f} of what is spent is what replies cost more than their "
            f"worst case: {told}"
        )
