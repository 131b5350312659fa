"""Published values that ship with the project; ``sources.csv`` cites each file."""

from __future__ import annotations

import csv
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from merge_runner.scenarios.merge.conditions import HUMAN_CONDITIONS

if TYPE_CHECKING:
    import pandas as pd

DATA = Path(__file__).parent
# Standard deviation in m of the human gaps about their regression: what the four standard errors of
# arXiv 2604.09609 (Table IV, human rows, n = 962) imply.
HUMAN_GAP_SD_M = 1.82
HUMAN = "human"  # the driver of every trial of the human experiment
HUMAN_TRIALS = 990
# The experiments whose pairs the publications number 1 to 9.
PAIRS = {
    experiment: f"pair{number}"
    for number, experiment in enumerate((4, 5, 6, 8, 9, 10, 11, 12, 13), start=1)
}
HUMAN_DOI = "10.4121/19550377"


class HumanCounts(NamedTuple):
    """Human trials of a condition by their outcome."""

    left_first: int
    right_first: int
    collided: int


@cache
def human_counts() -> dict[str, HumanCounts]:
    """Return the published outcomes by condition."""
    return {
        row["condition"]: HumanCounts(*(int(row[name]) for name in HumanCounts._fields))
        for row in _rows("human_outcomes")
    }


@cache
def citation(name: str) -> str:
    """Return the source of the values in a shipped file."""
    return next(row["citation"] for row in _rows("sources") if row["file"] == f"{name}.csv")


def _rows(name: str) -> list[dict[str, str]]:
    with (DATA / f"{name}.csv").open(encoding="utf-8", newline="") as file:
        return list(csv.DictReader(file))


@cache
def published(name: str) -> pd.DataFrame:
    """Return a shipped file, by its name without ``.csv``; texts stay texts, gaps become NaN."""
    import pandas as pd

    return pd.read_csv(DATA / f"{name}.csv", keep_default_na=False, na_values={})


def printed_value(value: str | float) -> str | float:
    """Return a printed number; a bound of p such as ``<0.001`` stays text."""
    return float(value) if isinstance(value, str) and not value.startswith("<") else value


def human_outcomes() -> pd.DataFrame:
    """Return the 990 human trials as far as they are published, with the columns of ``trials``."""
    import pandas as pd

    fates = (("finished", "left"), ("finished", "right"), ("collided", None))
    rows = [
        (name, at.projected_headway_m, at.relative_velocity_mps, *fate)
        for name, at in HUMAN_CONDITIONS.items()
        for fate, n in zip(fates, human_counts()[name], strict=True)
        for _ in range(n)
    ]
    names = ["condition", "projected_headway_m", "relative_velocity_mps", "status", "merged_first"]
    trials = pd.DataFrame(rows, columns=names)
    return trials.assign(collided_boxes=trials["status"] == "collided")
