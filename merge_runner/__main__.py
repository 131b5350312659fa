"""Entry point of the program ``merge-runner`` and of ``python -m merge_runner``."""

from __future__ import annotations

import atexit
import gc
import os
import sys


def main() -> None:
    """Run the command line, which is imported only after the path is set."""
    codes: list[int] = []
    atexit.register(_end, codes)  # before all others, and so called after them
    # Few objects are in reference cycles; commands that make most objects search even less often.
    gc.set_threshold(100_000, 10, 1_000)
    from merge_runner.cli import main as run

    try:
        run()
    except SystemExit as exc:
        if isinstance(exc.code, int):  # Python prints any other one
            codes.append(exc.code)
        raise


def _end(codes: list[int]) -> None:
    """End the process at once: to free all that a report has loaded takes most of a second."""
    if codes:
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(codes[0])


if __name__ == "__main__":
    # ``python -m`` puts the working folder first on the path: no file there may shadow a module.
    home = os.path.dirname(os.path.dirname(os.path.realpath(__file__)))
    if not sys.flags.safe_path and os.path.realpath(sys.path[0]) != home:
        del sys.path[0]
    main()
