"""Analyses of what lies in the results database, for a notebook as for the command line.

>>> from merge_runner_analysis import table
>>> table("results/merge.duckdb", "gap")

``Study`` holds what such a database has of its trials, to make several tables of it; a study that
can be run is ``merge_runner.Study``.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from merge_runner_analysis.frames import load, load_trials
    from merge_runner_analysis.study import StudyResults
    from merge_runner_analysis.tables import TABLES, table

# Names are loaded when they are used: the command line must not wait for pandas.
_PLACES = {
    "StudyResults": "merge_runner_analysis.study",
    "load": "merge_runner_analysis.frames",
    "load_trials": "merge_runner_analysis.frames",
    "table": "merge_runner_analysis.tables",
    "TABLES": "merge_runner_analysis.tables",
}
__all__ = ["TABLES", "StudyResults", "load", "load_trials", "table"]


def __getattr__(name: str) -> object:
    if name in _PLACES:
        return getattr(import_module(_PLACES[name]), name)
    raise AttributeError(f"module 'merge_runner_analysis' has no attribute {name!r}")
