"""The commands ``merge-runner human``."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from merge_runner.cli.help import Program
from merge_runner.cli.options import DbOption, JsonOption, print_out
from merge_runner.errors import UsageError
from merge_runner.paths import DEFAULT_DB
from merge_runner.text_safety import say

if TYPE_CHECKING:
    import pandas as pd


human_app = Program(
    help="The human recordings, 4TU doi 10.4121/19550377.\n\n"
    "Example: merge-runner human import 19550377.zip"
)
PathArgument = Annotated[
    Path,
    typer.Argument(
        metavar="PATH",
        help="The downloaded zip, the folder of its files, or one of the velocity pages.",
    ),
]


@human_app.command("import")
def human_import(path: PathArgument, db: DbOption = DEFAULT_DB) -> None:
    """Add the recorded human trials to the database.

    Stored ones stay unchanged.

    Example: merge-runner human import 19550377.zip
    """
    from merge_runner.results.store import Store
    from merge_runner_analysis.humans.archive import open_files
    from merge_runner_analysis.humans.imported import findings, human_trials
    from merge_runner_analysis.humans.load import import_trials, sort_files

    with open_files(path) as files:
        sources = sort_files(files)
        if not sources:
            raise UsageError(
                f"no trial is in {path}: trials are experiment_N_iter_M.csv, and velocity pages "
                "are named like 4_-8.html; unpack a zip within the download first"
            )
        report = import_trials(sources, Store(db))
    errors = [f"{name}: {reason}" for name, reason in report.unreadable]
    errors += [f"{trial} is stored with other values, which stay" for trial in report.differing]
    for line in errors:
        say(f"error: {line}")
    for line in findings(human_trials(db)):
        say(f"note: {line}")
    print_out(
        f"{report.added} trials added, {report.stored} there already, {len(report.unreadable)} "
        "files could not be read"
    )
    sys.exit(1 if errors else 0)


@human_app.command("status")
def human_status(db: DbOption = DEFAULT_DB, as_json: JsonOption = False) -> None:
    """Count the human trials, next to the published counts.

    Example: merge-runner human status --db results/merge.duckdb
    """
    from merge_runner_analysis.humans import imported as humans
    from merge_runner_analysis.published import HUMAN_DOI

    tables: dict[str, pd.DataFrame] = {}
    notes: list[str] = []
    if db.exists() and not (trials := humans.human_trials(db)).empty:
        tables = {
            "pairs": humans.counted(trials, "pair"),
            "conditions": humans.by_condition(trials),
        }
        notes = list(humans.findings(trials))
    if as_json:
        counts = {name: table.to_dict("index") for name, table in tables.items()}
        print_out(json.dumps({**counts, "notes": notes} if tables else {}, ensure_ascii=False))
        return
    for table in tables.values():
        shown = table.rename_axis(None).rename(columns=lambda name: name.replace("_", " "))
        print_out(f"{shown.to_string()}\n")
    if not tables:
        notes = [
            "no human recordings are imported: merge-runner human import PATH, where PATH is the "
            f"download of https://doi.org/{HUMAN_DOI}"
        ]
    for line in notes:
        print_out(line)
