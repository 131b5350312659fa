"""Analyses of what lies in the results database, for a notebook as for the command line.

>>> from analysis import Study, table
>>> study = Study("results/merge.duckdb")
>>> table(study, "gap")
"""

from __future__ import annotations

from importlib import import_module

# Names are loaded when they are used: the command line must not wait for pandas.
_PLACES = {
    "Study": "analysis.data.study",
    "load": "analysis.data.load",
    "load_trials": "analysis.data.load",
    "table": "analysis.tables",
    "TABLES": "analysis.tables",
}
__all__ = ["TABLES", "Study", "load", "load_trials", "table"]


def __getattr__(name: str) -> object:
    if name in _PLACES:
        return getattr(import_module(_PLACES[name]), name)
    raise AttributeError(f"module 'analysis' has no attribute {name!r}")
