"""The command that shows what was spent."""

from __future__ import annotations

import json
from itertools import chain
from typing import Annotated

import typer

from merge_runner.cli.options import CacheOption, JsonOption
from merge_runner.cli.output import agree, print_out
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
    from merge_runner.run import spending

    if release is None:
        found = spending.accounts(cache)
    else:
        aside = spending.account(cache, release).spending
        agree(
            f"{aside.reserved_usd:.4f} USD are set aside for {aside.open_attempts} attempts at "
            f"{release}. If the provider did charge for them, --max-cost may be passed by as much",
            "Release it?",
            otherwise="nothing was released",
            yes=yes,
        )
        found = [spending.release(cache, release)]
    if as_json:
        print_out(json.dumps([each.as_dict() for each in found], ensure_ascii=False))
        return
    for line in chain.from_iterable(each.lines() for each in found):
        print_out(line)
    if not found:
        print_out("No sweep has spent anything.")
