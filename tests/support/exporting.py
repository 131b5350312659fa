"""Exports of a study, in a thread: where a browser is there, this one has an event loop."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor

import pytest

from merge_runner_analysis.explorer.export import export_folder
from merge_runner_analysis.figures import FIGURES
from merge_runner_analysis.tables import TABLES

FEW_TABLES = {
    "merge_runner_analysis.explorer.pages.tables.TABLES": {"attempts": TABLES["attempts"]},
    "merge_runner_analysis.explorer.pages.tables.FIGURES": {
        "first-action": FIGURES["first-action"]
    },
}


def export(db, folder, wanted=()):
    """Export a study or some trials; gives the folder of all pages but the first."""
    with ThreadPoolExecutor(1) as thread:
        index = thread.submit(export_folder, db, folder, wanted).result()
    assert index == folder / "index.html"
    return folder / "files"


def export_with_a_table(db, folder):
    """Export the whole study with a table and a figure, which stand for all."""
    with pytest.MonkeyPatch.context() as patch:
        for name, few in FEW_TABLES.items():
            patch.setattr(name, few)
        return export(db, folder)
