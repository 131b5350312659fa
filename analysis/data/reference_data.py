"""Published values that ship with the project; ``data/sources.csv`` cites each file.

Counts, citations and paths are read without pandas, at once.
"""

from __future__ import annotations

import csv
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from merge_runner.results.export import SchemaColumn, SchemaTable
from merge_runner.scenarios.merge.conditions import HUMAN_CONDITIONS

if TYPE_CHECKING:
    import pandas as pd

DATA = Path(__file__).parent
# Standard deviation in m of the human gaps about their regression: what the four standard errors of
# arXiv 2604.09609 (Table IV, human rows, n = 962) imply.
HUMAN_GAP_SD_M = 1.82
HUMAN_TRIALS = 990
# The experiments whose pairs the publications number 1 to 9.
PAIRS = {
    experiment: f"pair{number}"
    for number, experiment in enumerate((4, 5, 6, 8, 9, 10, 11, 12, 13), start=1)
}
HUMAN_DOI = "10.4121/19550377"


QUARTILES = {
    "min": "smallest",
    "q1": "first quartile of the",
    "median": "median",
    "q3": "third quartile of the",
    "max": "largest",
}


class HumanCounts(NamedTuple):
    """Human trials of a condition by their outcome."""

    left_first: int
    right_first: int
    collided: int

    @property
    def trials(self) -> int:
        """All of them: each has one of these outcomes."""
        return sum(self)


@cache
def human_counts() -> dict[str, HumanCounts]:
    """The published outcomes by condition."""
    return {
        row["condition"]: HumanCounts(*(int(row[name]) for name in HumanCounts._fields))
        for row in _rows("human_outcomes")
    }


def outcomes_table() -> tuple[SchemaTable, Path]:
    """The published outcomes as a table of an export, and their file."""
    columns = [
        SchemaColumn("condition", "VARCHAR", "of the experiment"),
        SchemaColumn("left_first", "BIGINT", "trials in which the left vehicle merged first"),
        SchemaColumn("right_first", "BIGINT", "trials in which the right vehicle merged first"),
        SchemaColumn("collided", "BIGINT", "trials in which boxes overlapped"),
        *(
            SchemaColumn(f"crt_{name}_s", "DOUBLE", f"{word} conflict resolution time")
            for name, word in QUARTILES.items()
        ),
    ]
    source = citation("human_outcomes")
    table = SchemaTable("human_outcomes", is_view=False, comment=source, columns=columns)
    return table, DATA / "human_outcomes.csv"


@cache
def citation(name: str) -> str:
    """Where the values of a shipped file come from."""
    return next(row["citation"] for row in _rows("sources") if row["file"] == f"{name}.csv")


def _rows(name: str) -> list[dict[str, str]]:
    with (DATA / f"{name}.csv").open(encoding="utf-8", newline="") as file:
        return list(csv.DictReader(file))


@cache
def published(name: str) -> pd.DataFrame:
    """One shipped file, by its name without ``.csv``; texts stay texts, gaps become NaN."""
    import pandas as pd

    return pd.read_csv(DATA / f"{name}.csv", keep_default_na=False, na_values={})


def printed_value(value: str | float) -> str | float:
    """A printed number; a bound of p such as ``<0.001`` stays text."""
    return float(value) if isinstance(value, str) and not value.startswith("<") else value


def human_gap_pair_sd_m() -> float:
    """Standard deviation in m of the mean gap between the nine human pairs.

    It is that of their published random intercepts, which are shrunken: rather too small.
    """
    return float(published("human_gap_intercepts")["intercept_m"].std())


def human_outcomes() -> pd.DataFrame:
    """The 990 human trials as far as they are published.

    Columns as in ``trials``: condition, projected_headway_m, relative_velocity_mps, status,
    merged_first. ``collided_boxes``: the experiment's collisions are boxes that overlap.
    """
    import pandas as pd

    rows: list[tuple[object, ...]] = []
    for name, counts in human_counts().items():
        at = HUMAN_CONDITIONS[name]
        cell = name, at.projected_headway_m, at.relative_velocity_mps
        rows += [(*cell, "finished", "left")] * counts.left_first
        rows += [(*cell, "finished", "right")] * counts.right_first
        rows += [(*cell, "collided", None)] * counts.collided
    names = ["condition", "projected_headway_m", "relative_velocity_mps", "status", "merged_first"]
    trials = pd.DataFrame(rows, columns=names)
    return trials.assign(collided_boxes=trials["status"] == "collided")
