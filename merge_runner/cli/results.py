"""The commands on what is there: results, recordings, spending and models; and the emulator."""

from __future__ import annotations

import json
import shutil
import sys
import tempfile
from contextlib import closing
from dataclasses import asdict
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from merge_runner.cli import options as cli
from merge_runner.cli.options import agree, print_out
from merge_runner.errors import UsageError, unknown_name
from merge_runner.paths import DEFAULT_CACHE, DEFAULT_DB
from merge_runner.text_safety import say

if TYPE_CHECKING:
    from merge_runner.llm.ledger import Ledger

CACHE = "Replay from this cache folder, not from the stored replies."
SWEEP = "A sweep_id, which may be repeated; the newest sweep if none is given."
Form = Literal["text", "csv", "json"]
RecordingFile = Annotated[Path, typer.Argument(metavar="FILE", help="A recording (.parquet).")]

recording_app = typer.Typer(
    help="Portable recordings: one Parquet file that anyone can replay.", no_args_is_help=True
)


def sql(
    query: Annotated[str, typer.Argument(metavar="QUERY", help="One SQL query.")],
    db: cli.DbOption = DEFAULT_DB,
    output: Annotated[Form, typer.Option("--format", help="Form of the result.")] = "text",
    as_json: cli.JsonOption = False,
) -> None:
    """Query the results; also while a sweep runs. Nothing can be changed."""
    from merge_runner.results.database import fetched, names_of
    from merge_runner.results.export import write_csv, write_json, write_table
    from merge_runner.results.store import answer

    writers = {"text": write_table, "csv": write_csv, "json": write_json}
    # A slow reader of a pipe would otherwise keep every sweep from writing meanwhile.
    with tempfile.TemporaryFile("w+", encoding="utf-8", newline="") as spooled:
        with answer(db, query) as result:
            writers["json" if as_json else output](names_of(result), fetched(result), spooled)
        spooled.seek(0)
        shutil.copyfileobj(spooled, sys.stdout)


def digest(db: cli.DbOption = DEFAULT_DB, as_json: cli.JsonOption = False) -> None:
    """Print one line: a hash of all results, equal for equal results."""
    from merge_runner.results.store import results_digest

    value, trials = results_digest(db)
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
    """Check that each trial is there and follows from its replies."""
    from merge_runner.audit.checks import audit_recording
    from merge_runner.run.stored_replay import NOT_REPLAYED, audit_database

    cli.use_study(study, trust=trust)
    skipped: list[str] = []
    if recording is not None:
        if sweep_id is not None or cache is not None:
            raise UsageError("--recording is checked by itself: without --sweep and --cache")
        audits = [audit_recording(recording)]
    else:
        audits = audit_database(db, sweep_id, cache)
        told = {"calls.cached"} if cache is not None else set(NOT_REPLAYED)
        skipped = [name for name in NOT_REPLAYED if name in told or "calls" not in name]
    ok = all(found.ok for found in audits)
    if as_json:
        whole = {"ok": ok, "not_replayed": skipped, "audits": [found.as_dict() for found in audits]}
        print_out(json.dumps(whole, ensure_ascii=False))
    else:
        for found in audits:
            print_out("\n".join(found.lines()))
        if skipped:
            print_out(f"not checked, since no replay tells it: {', '.join(skipped)}")
    sys.exit(0 if ok else 1)


def forget(
    sweeps: Annotated[
        list[str], typer.Argument(metavar="SWEEP...", help="A sweep_id; * stands for anything.")
    ],
    db: cli.DbOption = DEFAULT_DB,
    yes: cli.YesOption = False,
) -> None:
    """Remove sweeps and their trials from the database.

    Their replies stay in the cache.
    """
    from merge_runner.results import store

    ids, going = store.to_forget(db, sweeps)
    agree(f"these go from {db}: {going}", "Remove them?", otherwise="nothing was removed", yes=yes)
    store.forget(db, ids)
    say(
        f"removed: {going}. Their replies stay in the cache: the same `merge-runner sweep` plays "
        "the trials again without a call"
    )


@recording_app.command("export")
def recording_export(
    file: RecordingFile,
    db: cli.DbOption = DEFAULT_DB,
    cache: cli.CacheOption = DEFAULT_CACHE,
    sweeps: Annotated[list[str] | None, cli.option("ID", SWEEP, "--sweep")] = None,
) -> None:
    """Write what sweeps asked and were answered into one file."""
    from merge_runner.llm.cache import ResponseCache
    from merge_runner.results.recording import export_recording, provenance_of
    from merge_runner.results.store import recorded_sweeps

    rows, keys = recorded_sweeps(db, sweeps or ())
    found = " and ".join(row["sweep_id"] for row in rows)
    if not keys:
        raise UsageError(f"the sweep {found} made no call: there is nothing to record")
    calls = export_recording(file, ResponseCache(cache, read_only=True), keys, provenance_of(rows))
    say(f"{calls} calls of {found} are in {file}")


@recording_app.command("import")
def recording_import(
    file: Annotated[
        Path, typer.Argument(metavar="FILE", help="A recording (.parquet), or a cache folder.")
    ],
    cache: cli.CacheOption = DEFAULT_CACHE,
) -> None:
    """Verify a recording or a cache folder, and add it to the cache."""
    from merge_runner.llm.cache import ResponseCache, import_folder
    from merge_runner.results.recording import import_recording

    take = import_folder if file.is_dir() else import_recording
    added, there = take(file, ResponseCache(cache))
    say(f"{added} calls added to {cache}, {there} were there already")


@recording_app.command("verify")
def recording_verify(file: RecordingFile) -> None:
    """Check that a file is as it was exported."""
    from merge_runner.results.recording import summarise

    found = summarise(file)
    say(f"{file} is whole: {found['calls']} calls, as they were exported")


@recording_app.command("info")
def recording_info(
    file: RecordingFile,
    as_json: cli.JsonOption = True,
) -> None:
    """Verify a recording and print what it holds, as JSON."""
    from merge_runner.results.recording import summarise

    print_out(json.dumps(summarise(file), indent=2, ensure_ascii=False))


def ledger(
    cache: cli.CacheOption = DEFAULT_CACHE,
    release: Annotated[
        str | None, cli.option("SWEEP", "Stop counting what is set aside.", "--release")
    ] = None,
    yes: cli.YesOption = False,
    as_json: cli.JsonOption = False,
) -> None:
    """Show what each sweep has spent, and what is set aside."""
    from merge_runner.llm.cache import ResponseCache
    from merge_runner.llm.ledger import Ledger, scopes
    from merge_runner.run.summary import as_table

    with closing(ResponseCache(cache, read_only=True)) as opened:
        names = scopes(opened)
        if release is not None:
            if release not in names:
                raise unknown_name("sweep", release, names, f"with a ledger in {cache}")
            _release(Ledger(opened, release), yes=yes)
            names = [release]
        ledgers = [Ledger(opened, name) for name in names]
        rows = [
            {"sweep": each.scope, **asdict(each.read()), "reasons": each.reasons()}
            for each in ledgers
        ]
    if as_json:
        print_out(json.dumps(rows, ensure_ascii=False))
        return
    reasons = [{"sweep": row["sweep"], **reason} for row in rows for reason in row.pop("reasons")]
    print_out(as_table(rows) or "No sweep has spent anything.")
    if reasons:
        print_out(f"What is set aside, and why:\n{as_table(reasons)}")


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


def models(as_json: cli.JsonOption = False) -> None:
    """List the models and programs that can drive."""
    from merge_runner.config import Price, key_status
    from merge_runner.drivers.registry import PROGRAMS
    from merge_runner.llm.ledger import cost_usd
    from merge_runner.llm.models import load_models, shutdown_notes
    from merge_runner.records import Usage
    from merge_runner.run.summary import as_table

    entries = load_models()
    rows: list[dict[str, Any]] = []
    for name, entry in entries.items():
        # A thousand tokens each: more may have a price of their own.
        costs = (cost_usd(entry, Usage(n, output_tokens=1000 - n)) for n in (1000, 0))
        usd = ["unknown" if cost is None else round(cost * 1000, 6) for cost in costs]
        rows.append(
            {
                "name": name,
                "provider": entry.provider,
                "key": key_status(entry),
                "usd_per_m_in": usd[0],
                "usd_per_m_out": usd[1],
                "shutdown": str(entry.shutdown or ""),
                "id": entry.id,
                "prices": entry.price.source if isinstance(entry.price, Price) else entry.price,
                "note": entry.note,
            }
        )
    for name, program in PROGRAMS.items():
        needs = {"provider": "program", "key": "not needed", "usd_per_m_in": 0, "usd_per_m_out": 0}
        rows.append(
            {**dict.fromkeys(rows[0], ""), **needs, "name": name, "note": program.described}
        )
    if as_json:
        print_out(json.dumps(rows, indent=2, ensure_ascii=False))
    else:
        notes = [f"{row['name']}: {note}" for row in rows if (note := row.pop("note"))]
        print_out("\n".join([as_table(rows), *notes]))
    for note in shutdown_notes(entries, datetime.now(UTC).date()):
        say(note)


def emulate(
    port: Annotated[int, cli.option("N", "0: any free port.", min=0, max=65535)] = 8765,
) -> None:
    """Serve the emulator on 127.0.0.1, and print its base URL."""
    import asyncio

    from merge_runner.emulator.server import run

    asyncio.run(run(port, announce=print_out))
