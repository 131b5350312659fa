"""The commands that keep recorded replies in files."""

from __future__ import annotations

import json
from contextlib import closing
from pathlib import Path
from typing import Annotated

import typer

from merge_runner.cli import options as cli
from merge_runner.cli.help import Program
from merge_runner.cli.options import print_out
from merge_runner.errors import UsageError
from merge_runner.paths import DEFAULT_CACHE, DEFAULT_DB
from merge_runner.text_safety import say

SWEEP = "A run's sweep_id; may be repeated. Default: the newest run whose replies are in the cache."
RecordingFile = Annotated[Path, typer.Argument(metavar="FILE", help="A recording (.parquet).")]

recording_app = Program(
    help="Portable recordings: one Parquet file that anyone can replay.\n\n"
    "Example: merge-runner recording export study.parquet"
)


@recording_app.command("export")
def recording_export(
    file: RecordingFile,
    db: cli.DbOption = DEFAULT_DB,
    cache: cli.CacheOption = DEFAULT_CACHE,
    sweeps: Annotated[list[str] | None, cli.option("ID", SWEEP, "--sweep")] = None,
    study: cli.StudyOption = None,
) -> None:
    """Write the requests and replies of runs into one file.

    Example: merge-runner recording export mine.parquet
    """
    from merge_runner.llm.cache import ResponseCache
    from merge_runner.results.recorded_sweeps import carried_plugins, provenance_of
    from merge_runner.results.recording import export_recording
    from merge_runner.results.store import results_digest
    from merge_runner.results.sweeps import sweeps_to_export

    if sweeps and study is not None:
        raise UsageError(cli.NOT_BOTH)
    named = sweeps or cli.runs_of_study(study, db) or ()
    with closing(ResponseCache(cache, read_only=True)) as opened:
        rows, keys = sweeps_to_export(db, named, opened.has_all)
        sweep_ids = " and ".join(row["sweep_id"] for row in rows)
        if not keys:
            raise UsageError(
                f"the sweep {sweep_ids} made no call: there is nothing to record; --sweep ID names "
                "another"
            )
        provenance = provenance_of(rows)
        calls = export_recording(file, opened, keys, provenance)
    say(f"{calls} calls of {sweep_ids} are in {file}")
    digest, trials = results_digest(db, [row["sweep_id"] for row in rows])
    # Failed trials are in it, and their errors; trials that wait for money are not.
    ended = all(row["exit_code"] == 0 for row in rows)
    same = (
        ", and that of a replay" if ended else " (that of a replay may differ: a run had problems)"
    )
    say(f"their digest{same}: {digest}  {trials} trials")
    if plugins := carried_plugins(provenance):
        say(f"with them the whole source of the study's plug-ins: {', '.join(plugins)}")


@recording_app.command("import")
def recording_import(
    file: Annotated[
        Path, typer.Argument(metavar="FILE", help="A recording (.parquet), or a cache folder.")
    ],
    cache: cli.CacheOption = DEFAULT_CACHE,
) -> None:
    """Verify a recording or a cache folder, and add it to the cache.

    Example: merge-runner recording import theirs.parquet
    """
    from merge_runner.llm.cache import ResponseCache, import_folder
    from merge_runner.results.recording import import_recording

    take = import_folder if file.is_dir() else import_recording
    with closing(ResponseCache(cache)) as opened:
        added, known = take(file, opened)
    say(f"{added} calls added to {cache}, {known} were there already")


@recording_app.command("verify")
def recording_verify(file: RecordingFile) -> None:
    """Check that a file is as it was exported.

    Example: merge-runner recording verify theirs.parquet
    """
    from merge_runner.results.recording_summary import summarise

    summary = summarise(file)
    say(f"{file} is whole: {summary['calls']} calls, as they were exported")


@recording_app.command("info")
def recording_info(
    file: RecordingFile,
    as_json: cli.JsonOption = False,
) -> None:
    """Verify a recording and print what it holds.

    Example: merge-runner recording info theirs.parquet
    """
    from merge_runner.results.recording_summary import summarise, summary_lines

    summary = summarise(file)
    as_text = json.dumps(summary, indent=2, ensure_ascii=False) if as_json else ""
    print_out(as_text or "\n".join(summary_lines(file, summary)))
