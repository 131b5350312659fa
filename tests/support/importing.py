"""Human recordings of a part of the experiment, imported into a study of the tests."""

from __future__ import annotations

from merge_runner.results.store import Store
from merge_runner.scenarios.merge.conditions import CONDITIONS
from merge_runner_analysis.human.archive import open_files
from merge_runner_analysis.human.load import import_trials, sort_files
from tests.support.recordings import drive, write_folder


def import_some(db, folder):
    """Two pairs in every condition, as a download that is not whole."""
    files = {}
    for experiment in (4, 6):
        for number, condition in enumerate(CONDITIONS):
            yields = "left" if "R" in condition else "right"
            name = f"experiment_{experiment}/experiment_{experiment}_iter_{number + 1}.csv"
            files[name] = drive(condition, yields=yields).csv()
    with open_files(write_folder(folder, files)) as found:
        import_trials(sort_files(found), Store(db))
