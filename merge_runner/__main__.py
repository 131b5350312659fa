"""Runs the command line: the program ``merge-runner``, and ``python -m merge_runner``."""

from __future__ import annotations

import os
import sys
from importlib.util import find_spec


def main() -> None:
    """Run all commands, those of the analysis among them; another ``analysis`` is named."""
    from merge_runner.cli.output import say
    from merge_runner.errors import UsageError

    stranger = _another_analysis()
    if stranger:
        say(
            f"error: {stranger} hides the package analysis of merge-runner: rename it, or "
            "take its folder off PYTHONPATH"
        )
        sys.exit(UsageError.exit_code)
    from analysis.commands import main as run

    run()


def _another_analysis() -> str:
    """Where Python finds an ``analysis`` that is not the one beside this package; empty if none."""
    found = find_spec("analysis")
    place = os.path.realpath((found and found.origin) or "")
    return "" if place == os.path.join(_home(), "analysis", "__init__.py") else place


def _home() -> str:
    """The folder in which both packages are."""
    return os.path.dirname(os.path.dirname(os.path.realpath(__file__)))


def _leave_out_working_folder() -> None:
    """Undo what ``python -m`` does: look for modules in the working folder before all others."""
    if not sys.flags.safe_path and os.path.realpath(sys.path[0]) != _home():
        del sys.path[0]


if __name__ == "__main__":
    _leave_out_working_folder()  # before anything else is imported
    main()
