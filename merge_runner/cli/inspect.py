"""The commands that read a database, check it, and remove sweeps from it."""

from __future__ import annotations

import json
import shutil
import sys
from pathlib import Path
from typing import Annotated, Literal

import typer

from merge_runner.cli import options as cli
from merge_runner.cli.options import agree, print_out
from merge_runner.errors import UsageError
from merge_runner.paths import DEFAULT_DB
from merge_runner.text_safety import say

CACHE = "Replay from this cache folder, not from the stored replies."
Form = Literal["text", "csv", "json"]


def sql(
    query: Annotated[str, typer.Argument(metavar="QUERY", help="One SQL query.")],
    db: cli.DbOption = DEFAULT_DB,
    output: Annotated[
        Form, cli.option("FORM", "text (the default), csv or json.", "--format", show_default=False)
    ] = "text",
    as_json: cli.JsonOption = False,
) -> None:
    """Query the results; also while a sweep runs. Nothing can be changed.

    Example: merge-runner sql "select status, count(*) from trials group by all"
    """
    import tempfile

    from merge_runner.results import database, export, store

    writers = {"text": export.write_table, "csv": export.write_csv, "json": export.write_json}
    # A slow reader of a pipe would otherwise keep every sweep from writing meanwhile.
    with tempfile.TemporaryFile("w+", encoding="utf-8", newline="") as spooled:
        with store.open_result(db, query) as result:
            writers["json" if as_json else output](
                database.names_of(result), database.fetched(result), spooled
            )
        spooled.seek(0)
        shutil.copyfileobj(spooled, sys.stdout)


def digest(
    db: cli.DbOption = DEFAULT_DB,
    study: cli.StudyOption = None,
    as_json: cli.JsonOption = False,
) -> None:
    """Print one line: a hash of all results, equal for equal results.

    Example: merge-runner digest --study my-study/study.toml
    """
    from merge_runner.results.store import results_digest

    value, trials = results_digest(db, cli.runs_of_study(study, db))
    as_text = f"{value}  {trials} trials"
    print_out(json.dumps({"digest": value, "trials": trials}) if as_json else as_text)


def audit(
    db: cli.DbOption = DEFAULT_DB,
    sweep_id: Annotated[
        str | None, cli.option("ID", "A sweep_id; everything if not given.", "--sweep")
    ] = None,
    recording: Annotated[
        Path | None, cli.option("FILE", "Check this recording instead of a database.")
    ] = None,
    cache: Annotated[Path | None, cli.option("DIR", CACHE)] = None,
    study: cli.StudyOption = None,
    trust: cli.TrustOption = False,
    as_json: cli.JsonOption = False,
) -> None:
    """Check that all trials are stored, and follow from their replies.

    Example: merge-runner audit --recording baseline.parquet
    """
    from merge_runner.audit.recording import audit_recording
    from merge_runner.run.stored_replay import NOT_REPLAYED, audit_database

    cli.use_study(study, trust=trust)
    skipped: list[str] = []
    if recording is not None:
        if any(option is not None for option in (sweep_id, cache, study)):
            raise UsageError(
                "--recording is checked by itself: without --sweep, --study and --cache"
            )
        audits = [audit_recording(recording)]
    else:
        if sweep_id is not None and study is not None:
            raise UsageError(cli.NOT_BOTH)
        named = [sweep_id] if sweep_id is not None else cli.runs_of_study(study, db)
        audits = audit_database(db, named, cache)
        of_calls = {"calls.cached"} if cache is not None else set(NOT_REPLAYED)
        skipped = [name for name in NOT_REPLAYED if name in of_calls or "calls" not in name]
    ok = all(result.ok for result in audits)
    if as_json:
        as_dicts = [result.as_dict() for result in audits]
        whole = {"ok": ok, "not_replayed": skipped, "audits": as_dicts}
        print_out(json.dumps(whole, ensure_ascii=False))
    else:
        for result in audits:
            print_out("\n".join(result.lines()))
        if skipped:
            print_out(f"not checked, since no replay tells it: {', '.join(skipped)}")
    sys.exit(0 if ok else 1)


def forget(
    sweeps: Annotated[
        list[str], typer.Argument(metavar="SWEEP", help="A sweep_id; * matches any text.")
    ],
    db: cli.DbOption = DEFAULT_DB,
    yes: cli.YesOption = False,
) -> None:
    """Remove sweeps and their trials from the database.

    Their replies stay in the cache.

    Example: merge-runner forget "baseline-*"
    """
    from merge_runner.results.sweeps import forget as forget_sweeps
    from merge_runner.results.sweeps import to_forget
    from merge_runner.run.progress_file import running_sweeps

    for busy in running_sweeps(db):
        raise UsageError(
            f"the sweep {busy.sweep_id} is running into {db}: stop it, or wait for its end"
        )
    ids, removed = to_forget(db, sweeps)
    agree(
        f"these go from {db}: {removed}", "Remove them?", otherwise="nothing was removed", yes=yes
    )
    forget_sweeps(db, ids)
    say(
        f"removed: {removed}. Their replies stay in the cache: the same `merge-runner sweep` plays "
        "the trials again without a call"
    )
