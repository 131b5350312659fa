"""Runs the command line: the program ``merge-runner``, and ``python -m merge_runner``."""

from __future__ import annotations

import os
import sys


def main() -> None:
    """Run the command line, which is imported only after the path is set."""
    from merge_runner.cli import main as run

    run()


if __name__ == "__main__":
    # ``python -m`` looks for modules in the working folder before all others: not for ours.
    home = os.path.dirname(os.path.dirname(os.path.realpath(__file__)))
    if not sys.flags.safe_path and os.path.realpath(sys.path[0]) != home:
        del sys.path[0]
    main()
