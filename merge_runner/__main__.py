"""Runs the command line: the program ``merge-runner``, and ``python -m merge_runner``."""

from __future__ import annotations

import os
import sys
from importlib.util import find_spec

HOME = os.path.dirname(os.path.dirname(os.path.realpath(__file__)))
"""The folder in which both packages are."""


def main() -> None:
    """Run all commands, those of the analysis among them; another ``analysis`` is named."""
    found = find_spec("analysis")
    place = os.path.realpath((found and found.origin) or "")
    if place != os.path.join(HOME, "analysis", "__init__.py"):
        from merge_runner.errors import UsageError
        from merge_runner.text_safety import say

        say(
            f"error: {place} hides the package analysis of merge-runner: rename it, or "
            "take its folder off PYTHONPATH"
        )
        sys.exit(UsageError.exit_code)
    from analysis.commands import main as run

    run()


if __name__ == "__main__":
    # ``python -m`` looks for modules in the working folder before all others: not for ours.
    if not sys.flags.safe_path and os.path.realpath(sys.path[0]) != HOME:
        del sys.path[0]
    main()
