"""The command that shows what was spent and what is reserved, and releases it."""

from __future__ import annotations

import json
from contextlib import closing
from dataclasses import asdict
from typing import TYPE_CHECKING, Annotated

import typer

from merge_runner.cli.options import CacheOption, JsonOption, agree, print_out
from merge_runner.errors import UsageError, unknown_name
from merge_runner.paths import DEFAULT_CACHE

if TYPE_CHECKING:
    from merge_runner.llm.ledger import Ledger


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
    from merge_runner.llm.cache import ResponseCache
    from merge_runner.llm.ledger import Ledger, scopes

    with closing(ResponseCache(cache, read_only=True)) as opened:
        names = scopes(opened)
        if release is not None:
            if release not in names:
                raise unknown_name("sweep", release, names, f"with a ledger in {cache}")
            _release(Ledger(opened, release), yes=yes)
            names = [release]
        ledgers = [Ledger(opened, name) for name in names]
        if as_json:
            accounts = [
                {"sweep": each.scope, **asdict(each.read()), "reasons": each.reasons()}
                for each in ledgers
            ]
            print_out(json.dumps(accounts, ensure_ascii=False))
            return
        for each in ledgers:
            _print(each)
        if not ledgers:
            print_out("No sweep has spent anything.")


def _release(ledger: Ledger, *, yes: bool) -> None:
    spending = ledger.read()
    agree(
        f"{spending.reserved_usd:.4f} USD are set aside for {spending.open_attempts} attempts at "
        f"{ledger.scope}. If the provider did charge for them, --max-cost may be passed by as much",
        "Release it?",
        otherwise="nothing was released",
        yes=yes,
    )
    if not ledger.cache.locks.take_all():
        raise UsageError(
            f"another merge-runner works with {ledger.cache.folder}: what it has in flight cannot "
            "be released; try again when it has ended"
        )
    ledger.release()


def _print(ledger: Ledger) -> None:
    """Print what a sweep has spent in lines for a reader."""
    spending = ledger.read()
    print_out(
        f"{ledger.scope}: {spending.spent_usd:.4f} USD spent, {spending.reserved_usd:.4f} set "
        f"aside for {spending.open_attempts} attempts whose cost is not known"
    )
    for each in ledger.reasons():
        killed = " now, or when a run was killed" if each["outcome"] == "in flight" else ""
        print_out(
            f"  {each['usd']:.4f} USD for {each['attempts']} attempts of {each['driver']}: "
            f"{each['outcome']}{killed}, {each['first']} to {each['last']} (as {each['slot']})"
        )
    if spending.overrun_usd:
        print_out(
            f"  {spending.overrun_usd:.4f} of what is spent is what replies cost more than their "
            f"worst case: {spending.dearest}"
        )
