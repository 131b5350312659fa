"""The commands of the analysis, beside those of the runner on one command line.

Libraries are imported where they are used, so that the runner's commands start at once.
"""

from __future__ import annotations

from merge_runner.cli import app, main

__all__ = ["app", "main"]
