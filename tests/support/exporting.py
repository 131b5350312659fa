"""Exports of a study, in a thread: where a browser is there, this one has an event loop."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor

from merge_runner_analysis.explorer.export import export_folder


def in_a_thread(function, *arguments):
    with ThreadPoolExecutor(1) as thread:
        return thread.submit(function, *arguments).result()


def export(db, folder, wanted=()):
    """Export a study or some trials; gives the folder of all pages but the first."""
    assert in_a_thread(export_folder, db, folder, wanted) == folder / "index.html"
    return folder / "files"
