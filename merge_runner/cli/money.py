"""The command that shows what sweeps have spent."""

from __future__ import annotations

import json
from contextlib import closing
from dataclasses import asdict
from typing import TYPE_CHECKING, Annotated

from merge_runner.cli import options as cli
from merge_runner.cli.options import agree, print_out
from merge_runner.errors import UsageError, unknown_name
from merge_runner.paths import DEFAULT_CACHE

if TYPE_CHECKING:
    from merge_runner.llm.cache import ResponseCache


def ledger(
    cache: cli.CacheOption = DEFAULT_CACHE,
    release: Annotated[
        str | None, cli.option("SWEEP", "Free the reservations of this sweep.", "--release")
    ] = None,
    yes: cli.YesOption = False,
    as_json: cli.JsonOption = False,
) -> None:
    """Show what each sweep has spent and reserved.

    Example: merge-runner ledger --cache cache/responses
    """
    from merge_runner.llm.cache import ResponseCache
    from merge_runner.llm.cache_format import require
    from merge_runner.llm.durable import LIVE
    from merge_runner.llm.ledger import APART, Ledger, reasons, scopes
    from merge_runner.run.summary import as_table

    require(cache)
    with closing(ResponseCache(cache, read_only=release is None)) as opened:
        names = scopes(opened)
        if release is not None:
            if release not in names:
                raise unknown_name("sweep", release, names, f"with a ledger in {cache}")
            _release(opened, release, yes=yes)
            names = [release]
        ledgers = [Ledger(opened, name) for name in names]
        rows = [
            {
                "sweep": ledger.scope,
                **asdict(ledger.read()),
                "reasons": reasons(opened, ledger.scope),
            }
            for ledger in ledgers
        ]
        # Without a live run only batches are in flight, and the next run asks for them.
        if not (cache / LIVE).exists() or opened.locks.take_all():
            for reason in (reason for row in rows for reason in row["reasons"]):
                if reason["outcome"] == "in flight":
                    reason["outcome"] = "in flight when its process ended"
    if as_json:
        print_out(json.dumps(rows, ensure_ascii=False))
        return
    why = [{"sweep": row["sweep"], **reason} for row in rows for reason in row.pop("reasons")]
    kept = [name for name in rows[0] if any(row[name] for row in rows)] if rows else []
    heads = {"open_attempts": "attempts of unknown cost"}
    spent = [{heads.get(name, name): row[name] for name in kept} for row in rows]
    text = "\n".join(filter(None, map(as_table, (spent, why))))
    print_out(f"{text}\n{APART}" if text else "Nothing is spent.")


def _release(cache: ResponseCache, name: str, *, yes: bool) -> None:
    from merge_runner.llm.ledger import Ledger

    ledger = Ledger(cache, name)
    spending = ledger.read()
    agree(
        f"{spending.reserved_usd:.4f} USD are reserved for {spending.open_attempts} "
        f"attempts at {name}. If the provider did charge for them, a cap may be "
        "passed by as much",
        "Release it?",
        otherwise="nothing was released",
        yes=yes,
    )
    if not cache.locks.take_all():
        raise UsageError(
            f"another merge-runner works with {cache.folder}: what it has in flight cannot be "
            "released; try again when it has ended"
        )
    ledger.release()
