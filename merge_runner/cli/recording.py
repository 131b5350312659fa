"""The commands on recordings."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer

from merge_runner.cli.options import CacheOption, DbOption, JsonOption, option
from merge_runner.cli.output import print_out, say
from merge_runner.errors import UsageError
from merge_runner.paths import DEFAULT_CACHE, DEFAULT_DB

SWEEP = "A sweep_id, which may be repeated; the newest sweep if none is given."
RecordingFile = Annotated[Path, typer.Argument(metavar="FILE", help="A recording (.parquet).")]

recording_app = typer.Typer(
    help="Portable recordings: one Parquet file that anyone can replay.", no_args_is_help=True
)


@recording_app.command("export")
def recording_export(
    file: RecordingFile,
    db: DbOption = DEFAULT_DB,
    cache: CacheOption = DEFAULT_CACHE,
    sweeps: Annotated[list[str] | None, option("ID", SWEEP, "--sweep")] = None,
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
    cache: CacheOption = DEFAULT_CACHE,
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
    say(f"{file} is whole: {found.calls} calls, as they were exported")


@recording_app.command("info")
def recording_info(
    file: RecordingFile,
    as_json: JsonOption = True,
) -> None:
    """Verify a recording and print what it holds, as JSON."""
    from dataclasses import asdict

    from merge_runner.results.recording import summarise

    print_out(json.dumps(asdict(summarise(file)), indent=2, ensure_ascii=False))
