"""The commands on results that are there."""

from __future__ import annotations

import json
import shutil
import sys
import tempfile
from enum import StrEnum
from itertools import chain
from pathlib import Path
from typing import Annotated

import typer

from merge_runner.cli.options import DbOption, JsonOption, StudyOption, TrustOption, use_study
from merge_runner.cli.output import agree, print_out, say
from merge_runner.errors import UsageError
from merge_runner.paths import DEFAULT_DB


class Format(StrEnum):
    """Output formats of a table."""

    TEXT = "text"
    CSV = "csv"
    JSON = "json"


def sql(
    query: Annotated[str, typer.Argument(metavar="QUERY", help="One SQL query.")],
    db: DbOption = DEFAULT_DB,
    output: Annotated[Format, typer.Option("--format", help="Form of the result.")] = Format.TEXT,
    as_json: JsonOption = False,
) -> None:
    """Query the results; also while a sweep runs. Nothing can be changed."""
    from merge_runner.results.database import fetched, names_of
    from merge_runner.results.query_output import write_csv, write_json, write_table
    from merge_runner.results.store import answer

    writers = {Format.TEXT: write_table, Format.CSV: write_csv, Format.JSON: write_json}
    # A slow reader of a pipe would otherwise keep every sweep from writing meanwhile.
    with tempfile.TemporaryFile("w+", encoding="utf-8", newline="") as spooled:
        with answer(db, query) as result:
            writers[Format.JSON if as_json else output](names_of(result), fetched(result), spooled)
        spooled.seek(0)
        shutil.copyfileobj(spooled, sys.stdout)


def digest(db: DbOption = DEFAULT_DB, as_json: JsonOption = False) -> None:
    """Print one line: a hash of all results, equal for equal results."""
    from merge_runner.results.store import results_digest

    value, trials = results_digest(db)
    if as_json:
        print_out(json.dumps({"digest": value, "trials": trials}))
    else:
        print_out(f"{value}  {trials} trials")


def audit(
    db: DbOption = DEFAULT_DB,
    sweep_id: Annotated[
        str | None,
        typer.Option("--sweep", metavar="ID", help="A sweep_id; everything if not given."),
    ] = None,
    recording: Annotated[
        Path | None,
        typer.Option(
            "--recording", metavar="FILE", help="Check this recording instead of a database."
        ),
    ] = None,
    cache: Annotated[
        Path | None,
        typer.Option(
            "--cache", metavar="DIR", help="Also compare every attempt with this cache folder."
        ),
    ] = None,
    study: StudyOption = None,
    trust: TrustOption = False,
    as_json: JsonOption = False,
) -> None:
    """Check that each trial is there and follows from its replies."""
    from merge_runner.audit.checks import audit_recording
    from merge_runner.run.stored_replay import NOT_REPLAYED, audit_database

    use_study(study, trust=trust)
    skipped: list[str] = []
    if recording is not None:
        if sweep_id is not None or cache is not None:
            raise UsageError("--recording is checked by itself: without --sweep and --cache")
        audits = [audit_recording(recording)]
    else:
        audits = audit_database(db, sweep_id, cache)
        skipped = list(NOT_REPLAYED)
        if cache is not None:
            skipped = [name for name in skipped if name == "calls.cached" or "calls" not in name]
    ok = all(found.ok for found in audits)
    if as_json:
        whole = {"ok": ok, "not_replayed": skipped, "audits": [found.as_dict() for found in audits]}
        print_out(json.dumps(whole, ensure_ascii=False))
    else:
        for line in chain.from_iterable(found.lines() for found in audits):
            print_out(line)
        if skipped:
            print_out(f"not checked, since no replay tells it: {', '.join(skipped)}")
    sys.exit(0 if ok else 1)


def forget(
    sweeps: Annotated[
        list[str] | None,
        typer.Argument(metavar="SWEEP", help="A sweep_id; * stands for anything."),
    ] = None,
    db: DbOption = DEFAULT_DB,
    yes: Annotated[bool, typer.Option("--yes", help="Do not ask before removing.")] = False,
) -> None:
    """Remove sweeps and their trials from the database.

    Their replies stay in the cache.
    """
    from merge_runner.results import forgetting

    if not sweeps:
        raise UsageError("name a sweep; `merge-runner sql 'from sweeps'` lists them")
    ids, going = forgetting.to_forget(db, sweeps)
    agree(
        f"these go from {db}: {going}",
        "Remove them?",
        otherwise="nothing was removed",
        yes=yes,
    )
    forgetting.forget(db, ids)
    say(
        f"removed: {going}. Their replies stay in the cache: the same `merge-runner sweep` plays "
        "the trials again without a call"
    )
