"""Finds out whether a language model drives like a human.

>>> from merge_runner import Study
>>> outcome = Study("study.toml").run()
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from merge_runner.api import Study, StudyOutcome

__all__ = ["Study", "StudyOutcome", "__version__"]

__version__ = "0.1.0"


def __getattr__(name: str) -> object:
    """Load a name when it is used: an import of the package takes no time."""
    if name in __all__:
        return getattr(import_module("merge_runner.api"), name)
    raise AttributeError(f"module 'merge_runner' has no attribute {name!r}")
