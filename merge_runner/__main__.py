"""Entry point of the program ``merge-runner`` and of ``python -m merge_runner``."""

from __future__ import annotations

import atexit
import gc
import os
import sys


def main() -> None:
    """Run the command line, which is imported only after the path is set."""
    # Trials and reports leave no reference cycles, and to search those in memory takes long.
    gc.set_threshold(100_000, 10, 1_000)
    atexit.register(gc.freeze)  # else the end of a report takes half a second more
    from merge_runner.cli import main as run

    run()


if __name__ == "__main__":
    # ``python -m`` puts the working folder first on the path: no file there may shadow a module.
    home = os.path.dirname(os.path.dirname(os.path.realpath(__file__)))
    if not sys.flags.safe_path and os.path.realpath(sys.path[0]) != home:
        del sys.path[0]
    main()
