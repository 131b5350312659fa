"""The commands ``merge-runner human``."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from merge_runner.cli.options import DbOption, JsonOption, print_out
from merge_runner.errors import UsageError
from merge_runner.paths import DEFAULT_DB
from merge_runner.text_safety import say

if TYPE_CHECKING:
    import pandas as pd

    from merge_runner_analysis.human.archive import File
    from merge_runner_analysis.human.load import Report

INTERRUPTED = 130
MOST_ALIKE = 20

human_app = typer.Typer(
    help="The human recordings, 4TU doi 10.4121/19550377.", no_args_is_help=True
)


@human_app.command("import")
def human_import(
    path: Annotated[
        Path,
        typer.Argument(
            metavar="PATH",
            help="The downloaded zip, the folder of its files, or the public velocity pages: a "
            "folder, or one of them.",
        ),
    ],
    db: DbOption = DEFAULT_DB,
) -> None:
    """Add the recorded human trials to the database.

    Those that are there stay as they are.
    """
    from rich.console import Console
    from rich.progress import track

    from merge_runner.results.store import Store
    from merge_runner_analysis.data.imported_humans import human_trials, imported
    from merge_runner_analysis.human.archive import open_files
    from merge_runner_analysis.human.load import import_pages, import_trials, sort_files

    try:
        with open_files(path) as files:
            download = sort_files(files)
            if not download.trials and not download.pages:
                raise UsageError(_nothing_in(path, files))
            shown = track(
                download.trials,
                "importing",
                console=Console(stderr=True),
                transient=True,
                disable=not sys.stderr.isatty(),
            )
            store = Store(db)
            report = import_trials(shown, store)
            import_pages(download.pages, store, report)
    except KeyboardInterrupt:
        say("interrupted: what is stored stays; run the same command again to go on")
        sys.exit(INTERRUPTED)
    for line in _errors(report):
        say(line)
    for line in imported(human_trials(db)).findings():
        say(f"note: {line}")
    print_out(
        f"{report.added} trials added, {report.there} there already, {len(report.unreadable)} "
        f"files could not be read, {download.skipped} training or simulated runs skipped"
    )
    sys.exit(1 if report.unreadable or report.differing else 0)


@human_app.command("status")
def human_status(db: DbOption = DEFAULT_DB, as_json: JsonOption = False) -> None:
    """Count the human trials, beside the published counts."""
    from merge_runner_analysis.data import imported_humans as humans
    from merge_runner_analysis.data.reference_data import HUMAN_DOI

    trials = humans.human_trials(db) if db.exists() else None
    tables: dict[str, pd.DataFrame] = {}
    notes: list[str] = []
    if trials is not None and not trials.empty:
        tables = {"pairs": humans.by_pair(trials), "conditions": humans.by_condition(trials)}
        notes = list(humans.imported(trials).findings())
    if as_json:
        counts = {name: table.to_dict("index") for name, table in tables.items()}
        print_out(json.dumps({**counts, "notes": notes} if tables else {}, ensure_ascii=False))
    elif not tables:
        print_out(
            "no human recordings are imported: merge-runner human import PATH, where PATH is the "
            f"download of https://doi.org/{HUMAN_DOI}"
        )
    else:
        for table in tables.values():
            shown = table.rename_axis(None).rename(columns=lambda name: name.replace("_", " "))
            print_out(f"{shown.to_string()}\n")
        for line in notes:
            print_out(line)


def _nothing_in(path: Path, files: list[File]) -> str:
    inner = [file.name for file in files if file.name.lower().endswith(".zip")]
    hint = f"; unpack it, and import {', '.join(inner)} of it" if inner else ""
    return (
        f"no trial is in {path}: trials are experiment_N_iter_M.csv, and velocity pages are named "
        f"like 4_-8.html{hint}"
    )


def _errors(report: Report) -> Iterator[str]:
    """One line a file that could not be read, and one line a reason that many share."""
    names: dict[str, list[str]] = {}
    for name, reason in report.unreadable:
        names.setdefault(reason, []).append(name)
    for reason, alike in names.items():
        if len(alike) > MOST_ALIKE:
            alike = [f"{len(alike)} files, the first is {alike[0]}"]  # noqa: PLW2901
        yield from (f"error: {name}: {reason}" for name in alike)
    for trial_id in report.differing:
        yield f"error: {trial_id} is stored with other values, which stay"
