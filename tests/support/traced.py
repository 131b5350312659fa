"""Counts the calls of merge-runner's functions: ``python -m tests.support.traced FILE ARGUMENTS``.

``FILE`` gets a JSON object: for each source file, the number of calls of its most called function.
"""

from __future__ import annotations

import contextlib
import json
import sys
import threading
from collections import Counter
from pathlib import Path
from types import FrameType

import merge_runner
from merge_runner.__main__ import main

PACKAGE = str(Path(merge_runner.__file__).parent) + "/"


def trace(arguments: list[str]) -> dict[str, int]:
    """Run a command; return the calls of the most called function of each file of the package."""
    calls: Counter[tuple[str, str]] = Counter()

    def count(frame: FrameType, event: str, _: object) -> None:
        if event == "call" and frame.f_code.co_filename.startswith(PACKAGE):
            calls[frame.f_code.co_filename, frame.f_code.co_qualname] += 1

    sys.argv = ["merge-runner", *arguments]
    threading.setprofile(count)
    sys.setprofile(count)
    with contextlib.suppress(SystemExit):
        main()
    sys.setprofile(None)
    most: Counter[str] = Counter()
    for (path, _), number in calls.items():
        file = path.removeprefix(PACKAGE)
        most[file] = max(most[file], number)
    return dict(most)


if __name__ == "__main__":
    Path(sys.argv[1]).write_text(json.dumps(trace(sys.argv[2:])))
