"""Writes an archive of human recordings as large as the published one, from the tests' driver."""

from __future__ import annotations

import sys
from pathlib import Path

from merge_runner.records import SIDES
from merge_runner.scenarios.merge.conditions import HUMAN_CONDITIONS
from tests.support.recordings import drive, write_zip

PAIRS, RUNS = 9, 10


def write_archive(path: Path) -> None:
    """9 pairs of humans, 10 runs of 11 conditions each."""
    recorded = [
        drive(condition, yields=yields).csv() for condition in HUMAN_CONDITIONS for yields in SIDES
    ]
    write_zip(
        path,
        {
            f"data/experiment_{pair}_iter_{number}.csv": recorded[number % len(recorded)]
            for pair in range(1, PAIRS + 1)
            for number in range(RUNS * len(HUMAN_CONDITIONS))
        },
    )


if __name__ == "__main__":
    write_archive(Path(sys.argv[1]))
